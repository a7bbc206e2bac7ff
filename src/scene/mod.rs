//! Floor 1: scene file → plan (only the effects it calls for) → frames with truth. Never uses `estimate`.
