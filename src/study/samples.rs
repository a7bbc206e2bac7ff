//! Writes training samples as a byte stream, so that a trainer needs neither a forward model nor stored data.
//!
//! One JSON line describes the stream (`Layout`); then each sample is `slots` × (column, row, energy) followed by
//! ny × nx pixels, all little-endian f4. Columns and rows count pixels, a pixel's centre at its integer; unused slots are
//! NaN. Energies are joules, pixels are in units of the noise's standard deviation.

use std::io::Write;

use rayon::prelude::*;
use serde::Serialize;

use crate::scene::{Plan, SimulatedFrame};

/// Most emitters a sample can name.
pub const SLOTS: usize = 16;
/// Samples made at a time, and of a device in a row.
const BATCH: u64 = 64;

/// The first line of the stream.
#[derive(Debug, Serialize)]
struct Layout {
    nx: usize,
    ny: usize,
    slots: usize,
    samples: u64,
    first: u64,
    noise_std_j: f64,
    spot_sigma_px: [f64; 2],
    ground_m_per_px: [f64; 2],
    scene: String,
}

/// Why the stream ended early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error("frame {frame} holds {found} emitters, a sample can hold {SLOTS}")]
    TooManyEmitters { frame: u64, found: usize },
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Writes samples `first .. first + samples`, 64 of each device in turn. Any part of a stream can be made again from its number.
///
/// `devices`: at least one, with cameras of one shape; the first is the one that the stream describes.
pub fn write(devices: &[Plan], scene: &str, first: u64, samples: u64, out: &mut impl Write) -> Result<(), Error> {
    let device = |k: u64| &devices[(k / BATCH) as usize % devices.len()];
    let camera = devices[0].camera();
    let pitch = [camera.x.pitch_m, camera.y.pitch_m];
    let layout = Layout {
        nx: camera.x.n,
        ny: camera.y.n,
        slots: SLOTS,
        samples,
        first,
        noise_std_j: camera.noise_std_j,
        spot_sigma_px: pitch.map(|p| camera.spot_sigma_m / p),
        ground_m_per_px: pitch.map(|p| camera.ground_scale() * p),
        scene: scene.to_owned(),
    };
    serde_json::to_writer(&mut *out, &layout).map_err(std::io::Error::from)?;
    out.write_all(b"\n")?;
    let end = first + samples;
    let mut next = first;
    while next < end {
        let stop = end.min(next + BATCH);
        let encoded: Vec<Vec<u8>> = (next..stop)
            .into_par_iter()
            .map(|k| encode(device(k), &device(k).frame(k)))
            .collect::<Result<_, _>>()?;
        for bytes in encoded {
            out.write_all(&bytes)?;
        }
        next = stop;
    }
    Ok(out.flush()?)
}

fn encode(plan: &Plan, simulated: &SimulatedFrame) -> Result<Vec<u8>, Error> {
    let camera = plan.camera();
    let emitters = &simulated.truth.emitters;
    if emitters.len() > SLOTS {
        return Err(Error::TooManyEmitters {
            frame: simulated.frame.index,
            found: emitters.len(),
        });
    }
    let mut values = vec![f32::NAN; 3 * SLOTS];
    for (slot, emitter) in values.chunks_exact_mut(3).zip(emitters) {
        let [x, y] = camera.to_sensor([emitter.x_m, emitter.y_m]);
        slot[0] = ((x - camera.x.centre(0)) / camera.x.pitch_m) as f32;
        slot[1] = ((y - camera.y.centre(0)) / camera.y.pitch_m) as f32;
        slot[2] = emitter.energy_j as f32;
    }
    values.extend(simulated.frame.pixels.iter().map(|v| (v / camera.noise_std_j) as f32));
    Ok(values.iter().flat_map(|v| v.to_le_bytes()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;

    #[test]
    fn a_sample_holds_its_frame_and_its_truth() {
        let plan = Plan::compile(&Scene::builtin(), 3).unwrap();
        let mut bytes = Vec::new();
        write(std::slice::from_ref(&plan), "builtin", 60, 2, &mut bytes).unwrap();
        let line = bytes.iter().position(|&b| b == b'\n').unwrap();
        let layout: serde_json::Value = serde_json::from_slice(&bytes[..line]).unwrap();
        assert_eq!((layout["nx"].as_u64(), layout["slots"].as_u64()), (Some(64), Some(16)));
        let values: Vec<f32> = bytes[line + 1..]
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
            .collect();
        assert_eq!(values.len(), 2 * (3 * SLOTS + 64 * 64));
        let simulated = plan.frame(61);
        let sample = &values[3 * SLOTS + 64 * 64..];
        let first = &simulated.truth.emitters[0];
        // A pixel is 30 mm/64 of sensor, 125/32 m of ground; pixel 0's centre is half a pixel from −125 m.
        let column = (first.x_m + 125.0) / (250.0 / 64.0) - 0.5;
        assert!((f64::from(sample[0]) - column).abs() < 1e-4, "{} {column}", sample[0]);
        let noise = plan.camera().noise_std_j;
        assert_eq!(sample[3 * SLOTS + 65], (simulated.frame.pixels[[1, 1]] / noise) as f32);
        assert!(sample[3 * simulated.truth.emitters.len()].is_nan());
    }

    #[test]
    fn devices_take_turns_wherever_a_stream_begins() {
        let plans: Vec<Plan> = [3, 4]
            .map(|seed| Plan::compile(&Scene::builtin(), seed).unwrap())
            .into();
        let stream = |first, samples| {
            let mut bytes = Vec::new();
            write(&plans, "builtin", first, samples, &mut bytes).unwrap();
            let line = bytes.iter().position(|&b| b == b'\n').unwrap();
            bytes.split_off(line + 1)
        };
        let (whole, part) = (stream(0, 130), stream(60, 8));
        let sample = 4 * (3 * SLOTS + 64 * 64);
        assert_eq!(whole[60 * sample..68 * sample], part);
        let of = |plan: &Plan, k: u64| encode(plan, &plan.frame(k)).unwrap();
        for (k, device) in [(63, 0), (64, 1), (127, 1), (128, 0)] {
            assert_eq!(whole[k * sample..(k + 1) * sample], of(&plans[device], k as u64), "{k}");
        }
    }
}
