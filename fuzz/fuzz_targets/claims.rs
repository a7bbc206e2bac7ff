//! Claims lines: parsed into finite claims that survive a round trip, or refused.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::claim::Claim;

fuzz_target!(|bytes: &[u8]| {
    for line in bytes.split(|b| *b == b'\n') {
        if let Ok(claim) = serde_json::from_slice::<Claim>(line) {
            let text = serde_json::to_string(&claim).expect("a claim is JSON");
            assert_eq!(serde_json::from_str::<Claim>(&text).expect("its own text"), claim);
        }
    }
});
