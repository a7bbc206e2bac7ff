//! One function a target: takes any bytes, and panics where a promise is broken.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use oapwatch::calibrate::file;
use oapwatch::claims::{self, Claim};
use oapwatch::config::Config;
use oapwatch::estimate;
use oapwatch::frames::npy::Reader;
use oapwatch::frames::v4l2::{Bayer, DecodeError, Decoding, Granted, Layout, PixelFormat, Region, Response, Transfer};
use oapwatch::geo::{Datum, Origin, Terrain};
use oapwatch::optics;
use oapwatch::platform::mavlink::{self, Event, Moment, Signing};
use oapwatch::platform::px4_log;
use oapwatch::pose::PoseSigmas;
use oapwatch::scene::{Plan, Scene};
use oapwatch::study::stability::trial;
use oapwatch::ulog;
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
    let formats = PixelFormat::ALL;
    let granted = Granted {
        format: formats[usize::from(head[18]) % formats.len()],
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
    let decoding = Decoding {
        region: (!bit(0)).then_some(region),
        shape,
        flip: [bit(1), bit(2)],
        saturation: None,
        response: Response {
            transfer: Transfer::ALL[usize::from(head[19] >> 5) % Transfer::ALL.len()],
            limited_range: bit(3),
        },
        black: 0.0,
        bayer: if bit(4) { Bayer::Sites } else { Bayer::Binned },
    };
    let Ok(layout) = Layout::new(granted, &decoding) else {
        return;
    };
    match layout.decode(image) {
        Ok(decoded) => {
            assert_eq!(decoded.counts.dim(), shape);
            assert!(decoded.counts.iter().all(|c| c.is_finite() && (*c >= 0.0 || bit(3))));
            assert!(decoded.saturated.is_none_or(|s| s.dim() == shape));
        }
        Err(DecodeError::Short { found, needed }) => assert!(found == image.len() && found < needed),
        Err(DecodeError::Jpeg(reason)) => assert!(granted.format.is_compressed() && !reason.is_empty()),
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

/// Telemetry: as one datagram, as a stream in two pieces, and as the payloads of frames whose checksums are right (message, length,
/// payload; again). Every pose is a rotation with a finite place and a positive diagonal of its covariance.
pub fn mavlink(bytes: &[u8]) {
    let check = |event: Event| {
        if let Event::Pose(sample) = event {
            assert!((sample.attitude.norm() - 1.0).abs() < 1e-9);
            assert!(sample.place.enu_m.iter().all(|v| v.is_finite()));
            assert!(sample.cov.iter().all(|v| v.is_finite()));
            assert!(sample.cov.diagonal().iter().all(|v| *v > 0.0));
        }
    };
    let second = 1_000_000_000;
    let moment = |k: usize| Moment {
        now_ns: (k as i64 + 1) * second / 50,
        unix_ns: 1_780_000_000 * second,
    };
    let heartbeat = mavlink::build(mavlink::Kind::Heartbeat, [1, 1], 0, &[0, 0, 0, 0, 2, 12], false);
    let reader = |signing| {
        let mut reader = mavlink::Reader::new(None, PoseSigmas::default(), signing);
        reader.datagram(&heartbeat, moment(0), &mut |_| {});
        reader
    };
    reader(None).datagram(bytes, moment(1), &mut |event| check(event));
    reader(Some(Signing::new([1; 32]))).datagram(bytes, moment(1), &mut |event| check(event));
    let (first, second) = bytes.split_at(bytes.len() / 2);
    let mut stream = reader(None);
    stream.stream(first, moment(1), &mut |event| check(event));
    stream.stream(second, moment(1), &mut |event| check(event));

    let mut framed = reader(None);
    let mut rest = bytes;
    for k in 1.. {
        let [message, length, ref payload @ ..] = *rest else {
            break;
        };
        let kind = mavlink::Kind::ALL[usize::from(message) % mavlink::Kind::ALL.len()];
        let (payload, next) = payload.split_at(payload.len().min(length.into()));
        framed.datagram(
            &mavlink::build(kind, [1, 1], 0, payload, false),
            moment(k),
            &mut |event| check(event),
        );
        rest = next;
    }
}

/// Flight logs: poses in order, each a rotation with a finite place, or a message.
pub fn ulg(bytes: &[u8]) {
    match ulog::read_from(bytes) {
        Ok(log) => {
            let poses = px4_log::poses(&log, PoseSigmas::default());
            assert!(poses.is_sorted_by_key(|pose| pose.time_us));
            for pose in poses {
                assert!((pose.attitude.norm() - 1.0).abs() < 1e-9);
                assert!(pose.place.enu_m.iter().all(|v| v.is_finite()) && pose.cov.iter().all(|v| v.is_finite()));
            }
        }
        Err(ulog::Fault::Malformed(_, message)) => assert!(!message.is_empty()),
        Err(ulog::Fault::Read(e)) => panic!("memory can be read: {e}"),
    }
}

/// GeoTIFF: ground that is finite where it is known, and that a ray from above meets there, or a message.
pub fn terrain(bytes: &[u8]) {
    let origin = Origin {
        latitude_deg: 48.137,
        longitude_deg: 11.575,
        height_m: 500.0,
        datum: Datum::Msl,
    };
    match Terrain::read(std::io::Cursor::new(bytes), "dem.tif", &origin) {
        Ok(terrain) => {
            for place in [[0.0, 0.0], [333.0, -150.0], [-5000.0, 1.0]] {
                let ground = terrain.at(place);
                assert!(ground.is_none_or(|g| g.z_m.abs() < 2e4 && g.slope.iter().all(|s| s.is_finite())));
                let lens = [place[0], place[1], 2e4].into();
                let met = terrain.cross(&lens, &[0.0, 0.0, -1.0].into());
                match (ground, met) {
                    (Some(ground), Some(met)) => assert!((ground.z_m - met.ground.z_m).abs() < 1e-6),
                    (None, None) => {}
                    // Along the edge of a void or of the grid either may round.
                    other => assert!(place != [0.0, 0.0] || terrain.voids().is_some(), "{other:?}"),
                }
                if let Some(met) = terrain.cross(&lens, &[0.7, -0.3, -1.0].into()) {
                    assert!(met.reach.is_finite() && met.ground.z_m.is_finite());
                }
            }
        }
        Err(e) => assert!(!e.to_string().is_empty()),
    }
}
