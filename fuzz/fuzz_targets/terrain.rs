#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| oapwatch_fuzz::targets::terrain(bytes));
