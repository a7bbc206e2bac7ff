//! Claims lines: parsed into finite claims that survive a round trip, or refused with a reason.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::claims::{Claim, Config, parse_line};

fuzz_target!(|bytes: &[u8]| {
    let config = Config::default();
    for line in bytes.split(|b| *b == b'\n') {
        match parse_line(line, &config) {
            Ok(claim) => {
                assert!(claim.x_m.is_finite() && claim.y_m.is_finite() && !claim.user.is_empty());
                assert!(claim.sigma_m.is_none_or(|s| s >= 0.0 && s.is_finite()));
                let text = serde_json::to_string(&claim).expect("a claim is JSON");
                assert_eq!(serde_json::from_str::<Claim>(&text).expect("its own text"), claim);
            }
            Err(e) => assert!(!e.to_string().is_empty()),
        }
    }
});
