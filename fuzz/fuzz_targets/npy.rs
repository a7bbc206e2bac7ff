//! Frame files: whatever the bytes, every frame has the shape that the header promised, or there is one error.
#![no_main]

use libfuzzer_sys::fuzz_target;
use oapwatch::frames::npy::Reader;

fuzz_target!(|bytes: &[u8]| {
    oapwatch_fuzz::with_file(bytes, |path| {
        let Ok(mut reader) = Reader::open(path, Some(1e-9)) else {
            return;
        };
        let shape = reader.shape();
        assert!(shape.0 > 0 && shape.1 > 0 && reader.frames() > 0);
        let _ = reader.seek(reader.frames() - 1).and_then(|()| reader.seek(0));
        let mut errors = 0;
        for frame in reader.take(64) {
            match frame {
                Ok(pixels) => assert_eq!(pixels.dim(), shape),
                Err(_) => errors += 1,
            }
        }
        assert!(errors <= 1);
    });
});
