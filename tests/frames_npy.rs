//! Frame files as strangers write them: every dtype and byte order, and every way to be wrong.

use std::io::Write;
use std::path::PathBuf;

use ndarray::Array2;
use oapwatch::frames::npy::{Error, Reader, Writer};

/// A version 1 file with a given header and data.
fn npy(dict: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend_from_slice(&(dict.len() as u16).to_le_bytes());
    bytes.extend_from_slice(dict.as_bytes());
    bytes.extend_from_slice(data);
    bytes
}

fn dict(descr: &str, shape: &str) -> String {
    format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n")
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn file(&self, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join("frames.npy");
        std::fs::File::create(&path).unwrap().write_all(bytes).unwrap();
        path
    }

    fn open(&self, bytes: &[u8], scale: Option<f64>) -> Result<Reader, Error> {
        Reader::open(self.file(bytes), scale)
    }

    fn refusal(&self, bytes: &[u8]) -> Error {
        let error = self.open(bytes, None).expect_err("a file that cannot be read");
        assert!(error.to_string().contains("frames.npy"), "{error}");
        error
    }
}

#[test]
fn every_dtype_and_byte_order_gives_joules() {
    let folder = Folder::new();
    let values = [0.0, 1.0, 2.5, -3.0, 4.0, 250.0];
    let counts = [0u16, 1, 2, 3, 255, 250];
    let f = |bytes: fn(f64) -> Vec<u8>| values.iter().flat_map(|v| bytes(*v)).collect::<Vec<_>>();
    let u = |bytes: fn(u16) -> Vec<u8>| counts.iter().flat_map(|v| bytes(*v)).collect::<Vec<_>>();
    let cases: [(&str, Vec<u8>); 7] = [
        ("<f8", f(|v| v.to_le_bytes().to_vec())),
        (">f8", f(|v| v.to_be_bytes().to_vec())),
        ("<f4", f(|v| (v as f32).to_le_bytes().to_vec())),
        (">f4", f(|v| (v as f32).to_be_bytes().to_vec())),
        ("|u1", u(|v| vec![v as u8])),
        ("<u2", u(|v| v.to_le_bytes().to_vec())),
        (">u2", u(|v| v.to_be_bytes().to_vec())),
    ];
    for (descr, data) in cases {
        let expected: Vec<f64> = match descr.contains('f') {
            true => values.to_vec(),
            false => counts.iter().map(|c| f64::from(*c) * 0.5).collect(),
        };
        for (shape, frames) in [("(1, 2, 3)", 1), ("(2, 3)", 1), ("(3L, 1L, 2L)", 3)] {
            let reader = folder.open(&npy(&dict(descr, shape), &data), Some(0.5)).unwrap();
            assert_eq!(reader.frames(), frames);
            let read: Vec<f64> = reader.flat_map(|frame| frame.unwrap().into_iter()).collect();
            assert_eq!(read, expected, "{descr} {shape}");
        }
    }
}

#[test]
fn rows_are_y_and_columns_are_x() {
    let folder = Folder::new();
    let data: Vec<u8> = (0..6u8).collect();
    let frame = folder
        .open(&npy(&dict("|u1", "(2, 3)"), &data), Some(1.0))
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    assert_eq!(frame, ndarray::array![[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]);
}

#[test]
fn a_cut_file_gives_its_complete_frames_and_then_one_error() {
    let folder = Folder::new();
    let mut reader = folder
        .open(&npy(&dict("|u1", "(4, 2, 2)"), &[7; 10]), Some(1.0))
        .unwrap();
    assert!(reader.next().unwrap().is_ok());
    assert!(reader.next().unwrap().is_ok());
    let error = reader.next().unwrap().unwrap_err();
    assert!(
        matches!(
            error,
            Error::Truncated {
                frame: 2,
                frames: 4,
                expected: 4,
                found: 2,
                ..
            }
        ),
        "{error}"
    );
    assert!(reader.next().is_none());
}

#[test]
fn seeking_gives_the_same_frames_again() {
    let folder = Folder::new();
    let data: Vec<u8> = (0..8u8).collect();
    let mut reader = folder.open(&npy(&dict("|u1", "(4, 1, 2)"), &data), Some(1.0)).unwrap();
    let all: Vec<Array2<f64>> = reader.by_ref().map(Result::unwrap).collect();
    reader.seek(2).unwrap();
    assert_eq!(reader.next().unwrap().unwrap(), all[2]);
    assert_eq!(reader.position(), 3);
    assert!(matches!(
        reader.seek(4),
        Err(Error::NoSuchFrame {
            frame: 4,
            frames: 4,
            ..
        })
    ));
}

#[test]
fn what_is_no_frame_file_is_refused_with_what_was_found() {
    let folder = Folder::new();
    let f8 = [0; 8];
    assert!(matches!(folder.refusal(b""), Error::NotNpy { .. }));
    assert!(matches!(folder.refusal(b"PK\x03\x04 an npz"), Error::NotNpy { .. }));
    assert!(matches!(
        folder.refusal(b"\x93NUMPY\x07\x00\x10\x00"),
        Error::Version { major: 7, .. }
    ));
    assert!(matches!(folder.refusal(&npy("nonsense", &[])), Error::Header { .. }));
    let wrong_dtype = folder.refusal(&npy(&dict("<i4", "(1, 1, 1)"), &f8));
    assert!(wrong_dtype.to_string().contains("<i4"), "{wrong_dtype}");
    let record = "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1, 1), }";
    assert!(matches!(folder.refusal(&npy(record, &f8)), Error::Dtype { .. }));
    let fortran = "{'descr': '<f8', 'fortran_order': True, 'shape': (1, 1, 1), }";
    assert!(matches!(folder.refusal(&npy(fortran, &f8)), Error::FortranOrder { .. }));
    for (shape, dimensions) in [("()", 0), ("(1,)", 1), ("(1, 1, 1, 1)", 4)] {
        match folder.refusal(&npy(&dict("<f8", shape), &f8)) {
            Error::Dimensions { found, .. } => assert_eq!(found.len(), dimensions),
            other => panic!("{shape}: {other}"),
        }
    }
    for shape in ["(0, 4, 4)", "(4, 0, 4)", "(4, 4, 0)"] {
        assert!(matches!(
            folder.refusal(&npy(&dict("<f8", shape), &[])),
            Error::Empty { .. }
        ));
    }
    assert!(matches!(
        folder.refusal(&npy(&dict("|u1", "(1, 1)"), &[1])),
        Error::NoScale { .. }
    ));
    let missing = Reader::open(folder.0.path().join("none.npy"), None).unwrap_err();
    assert!(missing.to_string().contains("none.npy"));
    assert!(matches!(Reader::open(folder.0.path(), None), Err(Error::Io { .. })));
}

#[test]
fn absurd_sizes_are_refused_without_allocating_them() {
    let folder = Folder::new();
    for shape in [
        "(1, 18446744073709551615, 18446744073709551615)",
        "(18446744073709551615, 4096, 4096)",
        "(1, 4097, 1)",
    ] {
        let error = folder.refusal(&npy(&dict("<f8", shape), &[]));
        assert!(matches!(error, Error::TooLarge { .. }), "{shape}: {error}");
    }
    let more_than_u64 = dict("<f8", "(1, 1, 99999999999999999999999)");
    assert!(matches!(
        folder.refusal(&npy(&more_than_u64, &[])),
        Error::Header { .. }
    ));
    let long_header = b"\x93NUMPY\x02\x00\xff\xff\xff\xff";
    assert!(matches!(folder.refusal(long_header), Error::HeaderLength { .. }));
    let deep = format!("{{'descr': {}", "[".repeat(9_000));
    assert!(matches!(folder.refusal(&npy(&deep, &[])), Error::Header { .. }));
    let mut promises_much = folder
        .open(&npy(&dict("<f8", "(1000000, 4096, 4096)"), &[0; 5]), None)
        .unwrap();
    assert!(matches!(
        promises_much.next().unwrap(),
        Err(Error::Truncated { frame: 0, found: 5, .. })
    ));
}

#[test]
fn the_writer_s_file_is_valid_after_every_frame() {
    let folder = Folder::new();
    let path = folder.0.path().join("written.npy");
    let mut writer = Writer::create(&path, (2, 3)).unwrap();
    assert!(matches!(Reader::open(&path, None), Err(Error::Empty { .. })));
    for k in 0..3u64 {
        let frame = Array2::from_shape_fn((2, 3), |(y, x)| k as f64 + 0.1 * y as f64 + 1e-17 * x as f64);
        writer.push(frame.view()).unwrap();
        assert_eq!(writer.size(), std::fs::metadata(&path).unwrap().len());
        let read: Vec<_> = Reader::open(&path, None).unwrap().map(Result::unwrap).collect();
        assert_eq!(read.len() as u64, k + 1);
        assert_eq!(read[k as usize], frame);
    }
    let wrong = Array2::zeros((3, 2));
    assert!(matches!(writer.push(wrong.view()), Err(Error::Shape { .. })));
    assert_eq!(writer.frames(), 3);
}

proptest::proptest! {
    /// Whatever the bytes are, the answer is frames or an error, never a panic or a large allocation.
    #[test]
    fn no_header_breaks_the_reader(text in "[\\{\\}\\(\\)\\[\\]':, a-zA-Z0-9<>|_]{0,120}", tail in proptest::collection::vec(0u8..255, 0..32)) {
        let folder = Folder::new();
        for dict in [text.clone(), format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {text}"), format!("{{'descr': {text}")] {
            if let Ok(reader) = folder.open(&npy(&dict, &tail), Some(1.0)) {
                proptest::prop_assert!(reader.take(4).count() <= 4);
            }
        }
    }
}
