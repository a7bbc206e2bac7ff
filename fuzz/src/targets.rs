//! One function a target: takes any bytes, and panics where a promise is broken.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use oapwatch::calibrate::file;
use oapwatch::claims::{self, Claim};
use oapwatch::config::Config;
use oapwatch::estimate;
use oapwatch::frames::npy::Reader;
use oapwatch::frames::v4l2::{Granted, Layout, PixelFormat, Region};
use oapwatch::optics;
use oapwatch::scene::{Plan, Scene};
use oapwatch::study::stability::trial;
use sha2::{Digest, Sha256};

/// Runs `target` on a file that holds `bytes`, in memory where that is possible.
fn with_file(bytes: &[u8], target: impl FnOnce(&Path)) {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let memory = Path::new("/dev/shm");
    let folder: PathBuf = if memory.is_dir() {
        memory.into()
    } else {
        std::env::temp_dir()
    };
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let path = folder.join(format!("oapwatch-fuzz-{}-{number}", std::process::id()));
    std::fs::write(&path, bytes).expect("a place to write to");
    target(&path);
    std::fs::remove_file(&path).expect("the file is still there");
}

/// Frame files: every frame has the shape that the header promised, or there is one error.
pub fn npy(bytes: &[u8]) {
    with_file(bytes, |path| {
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
}

/// Configs: read or refused with a message; what is read and holds together is a camera.
pub fn config(bytes: &[u8]) {
    with_file(bytes, |path| match Config::load(path) {
        Ok(config) => {
            let tables = [
                config.monitor.validate().err().map(|e| e.to_string()),
                config.claims.validate().err().map(|e| e.to_string()),
                config.api.validate().err().map(|e| e.to_string()),
            ];
            assert!(tables.iter().flatten().all(|message| !message.is_empty()));
            match config.optics.camera() {
                Ok(camera) => assert!(camera.spot_sigma_m > 0.0 && camera.noise_std_j > 0.0),
                Err(e) => assert!(!e.to_string().is_empty()),
            }
        }
        Err(e) => assert!(!e.to_string().is_empty()),
    });
}

/// Calibration files: applied to a camera whose map stays finite over the sensor, or refused.
pub fn calibration(bytes: &[u8]) {
    with_file(bytes, |path| {
        let Ok(calibration) = file::read(path) else {
            return;
        };
        let camera = optics::Config::default().camera().expect("the default is a camera");
        let Ok(camera) = calibration.applied_to(&camera) else {
            return;
        };
        for sensor in [[0.0, 0.0], [0.015, 0.015], [-0.015, 0.007]] {
            let ground = camera.to_ground(sensor);
            assert!(ground.iter().all(|p| p.is_finite()), "{sensor:?} → {ground:?}");
            assert!(camera.spot_sigma_at(sensor) > 0.0);
        }
    });
}

/// Scene files: compiled into a plan, or refused with a message.
pub fn scene(bytes: &[u8]) {
    with_file(bytes, |path| match Scene::load(path) {
        Ok(scene) => match Plan::compile(&scene, 1) {
            Ok(plan) => assert!(plan.rate_hz() > 0.0),
            Err(e) => assert!(!e.to_string().is_empty()),
        },
        Err(e) => assert!(!e.to_string().is_empty()),
    });
}

/// Lines of the claims log: a finite claim that survives a round trip, or a reason.
pub fn claims(bytes: &[u8]) {
    let config = claims::Config::default();
    for line in bytes.split(|b| *b == b'\n') {
        match claims::parse_line(line, &config) {
            Ok(claim) => {
                assert!(claim.x_m.is_finite() && claim.y_m.is_finite() && !claim.user.is_empty());
                assert!(claim.sigma_m.is_none_or(|s| s >= 0.0 && s.is_finite()));
                let text = serde_json::to_string(&claim).expect("a claim is JSON");
                let again: Claim = serde_json::from_str(&text).expect("its own text");
                assert_eq!(again, claim);
            }
            Err(e) => assert!(!e.to_string().is_empty()),
        }
    }
}

/// Device images: whatever the driver grants and delivers, an array of the configured shape or none. The first 20 bytes are
/// the grant, the rest is the image.
pub fn v4l2(bytes: &[u8]) {
    let Some((head, image)) = bytes.split_at_checked(20) else {
        return;
    };
    let word = |k: usize| u16::from_le_bytes([head[2 * k], head[2 * k + 1]]);
    let formats = [PixelFormat::GREY, PixelFormat::Y10, PixelFormat::Y12];
    let granted = Granted {
        format: formats[usize::from(head[18]) % 3],
        width: word(0).into(),
        height: word(1).into(),
        stride: word(2).into(),
    };
    let region = Region {
        x: word(3).into(),
        y: word(4).into(),
        width: word(5).into(),
        height: word(6).into(),
    };
    let bit = |k: u8| head[19] >> k & 1 == 1;
    let shape = (usize::from(word(8) % 64) + 1, usize::from(word(7) % 64) + 1);
    let Ok(layout) = Layout::new(granted, (!bit(0)).then_some(region), shape, [bit(1), bit(2)], None) else {
        return;
    };
    match layout.decode(image) {
        Some((counts, saturated)) => {
            assert_eq!(counts.dim(), shape);
            assert!(counts.iter().all(|c| *c >= 0.0 && c.is_finite()));
            assert!(saturated.is_none_or(|s| s.dim() == shape));
        }
        None => assert!(image.len() < layout.bytes_needed()),
    }
}

/// Frames of any bits on arrays up to 12 × 12: nothing malformed comes out. Shape and σ_eff first, then pixels.
pub fn locate(bytes: &[u8]) {
    let [nx, ny, sigma, ref pixels @ ..] = *bytes else {
        return;
    };
    let size = [usize::from(nx % 12) + 1, usize::from(ny % 12) + 1];
    let camera = trial::camera(size, 1e-5 * 1.06f64.powi(sigma.into()));
    let values = pixels.as_chunks::<4>().0;
    if values.is_empty() {
        return;
    }
    let value = |k: usize| f64::from(f32::from_le_bytes(values[k % values.len()]));
    let shape = camera.shape();
    let frame = trial::frame(ndarray::Array2::from_shape_fn(shape, |(y, x)| value(y * shape.1 + x)));
    let mut estimator = estimate::build(&estimate::Config::default(), &camera).expect("the default");
    if let Ok(estimate) = estimator.estimate(&frame) {
        let faults = trial::faults(&estimate);
        assert!(faults.is_empty(), "{faults:?}");
    }
}

/// ONNX files with a card that fits them: a network that takes a frame, or a message.
pub fn onnx(bytes: &[u8]) {
    with_file(bytes, |path| {
        let model = path.with_extension("onnx");
        let card = path.with_extension("toml");
        let hash: String = Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect();
        std::fs::copy(path, &model).expect("a place to write to");
        std::fs::write(
            &card,
            format!("sha256 = \"{hash}\"\nshape = [64, 64]\nfloor_sigma = 5.0\n"),
        )
        .expect("a place to write to");
        let config = estimate::Config {
            name: Some("network".into()),
            network: Some(model.clone()),
            ..estimate::Config::default()
        };
        let camera = optics::Config::default().camera().expect("the default is a camera");
        let built = estimate::build(&config, &camera);
        for file in [model, card] {
            std::fs::remove_file(file).expect("the file is still there");
        }
        match built {
            Ok(mut estimator) => {
                let frame = trial::frame(ndarray::Array2::zeros(camera.shape()));
                if let Ok(estimate) = estimator.estimate(&frame) {
                    assert!(trial::faults(&estimate).is_empty());
                }
            }
            Err(e) => assert!(!e.to_string().is_empty()),
        }
    });
}
