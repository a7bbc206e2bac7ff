//! More claims than there is room or time for.

use crate::claims::Squeeze;

/// Claims that found no room or time, lately, and the room there is.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::monitor) struct Overload {
    pub squeezed: Squeeze,
    /// Claims that bear on the view and that the frame had no time for.
    pub left_out: usize,
    pub users: usize,
    pub max_users: usize,
}
