//! Emitters that are hard to resolve, faint, or many.

use super::trial::{Source, anywhere, camera, energy, expose, observe};
use super::{Case, false_alarms_allowed};

const GROUP: &str = "Emitters";
/// Standard deviations beyond which a position without a warning counts as wrong; 1e-7 of correct ones lie beyond.
pub(super) const LIMIT: f64 = 6.0;

pub(super) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    cases.extend([2.0, 1.0, 0.5, 0.1, 1e-2, 1e-4, 1e-8, 1e-12, 0.0].map(pair));
    cases.extend([1e1, 1e2, 1e3, 1e4, 1e5, 1e6].map(unequal));
    cases.extend([-1.0, 0.0, 1.0, 2.0, 4.0, 8.0, 100.0].map(at_edge));
    cases.extend([at_corner(), nobody(), faint(), forty(), line_of_five()]);
    cases
}

/// Two equal emitters `d` σ apart, each with a signal-to-noise ratio of 1000.
fn pair(d: f64) -> Case {
    const SNR: f64 = 1e3;
    // Two emitters can be resolved from d ≥ 5σ/√SNR; half as much again covers nine frames in ten.
    let is_resolvable = d >= 7.5 / SNR.sqrt();
    let expected = if is_resolvable {
        "two found; no position without a warning is off by more than 6 of its own σ; from 1 σ on nine in ten carry none"
    } else {
        "one or two; where they cannot be told apart, one at their middle or a warning; the energy is right"
    };
    Case::new(
        GROUP,
        format!("two at d = {d:e} σ"),
        "the Jacobian's columns become parallel; its condition grows as d⁻³",
        expected,
        move |options| {
            let camera = camera([32, 32], 1e-3);
            let each = energy(&camera, SNR);
            let tally = observe(options, &camera, |rng| {
                let [x, y] = anywhere(&camera, 5e-3, rng);
                let half = 0.5 * d * camera.spot_sigma_m;
                let sources = [-1.0, 1.0].map(|s| Source {
                    sensor_m: [x + 0.6 * s * half, y + 0.8 * s * half],
                    energy_j: each,
                });
                (expose(&camera, &sources, rng), sources.to_vec())
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |truth| {
                let middle = [0, 1].map(|k| 0.5 * (truth[0].sensor_m[k] + truth[1].sensor_m[k]));
                let mut places: Vec<_> = truth.iter().map(|s| s.sensor_m).collect();
                if !is_resolvable {
                    places.push(middle);
                }
                places
            });
            let mut energies: Vec<f64> = tally
                .estimates()
                .map(|(_, e)| (e.emitters.iter().map(|e| e.energy_j).sum::<f64>() / (2.0 * each) - 1.0).abs())
                .collect();
            energies.sort_by(|a, b| b.total_cmp(a));
            let allowed = false_alarms_allowed(options.frames);
            let worst_energy = energies.get(allowed).copied().unwrap_or(0.0);
            let counted = tally.share_counted();
            // The sum is known to about 1/(2·SNR) of itself; twelve times that allows for the shape that one spot lacks.
            let speaks_out = d < 1.0 || clean * 10 >= 18 * options.frames;
            let holds =
                stray <= allowed && speaks_out && worst_energy < 6.0 / SNR && (!is_resolvable || counted >= 0.9);
            let remark = format!(
                "both seen in {:.0} %; {stray} of {clean} clean positions astray; energy within {worst_energy:.1e}",
                100.0 * counted
            );
            tally.observed(holds, &remark)
        },
    )
}

fn unequal(ratio: f64) -> Case {
    Case::new(
        GROUP,
        format!("energies 1:{ratio:e}"),
        "the bright one's model error must stay below the faint one's light, 4σ away",
        "both found, nine in ten without a warning, each of those within 6 of its own σ",
        move |options| {
            let camera = camera([32, 32], 1e-3);
            let faint = energy(&camera, 30.0);
            let tally = observe(options, &camera, |rng| {
                let [x, y] = anywhere(&camera, 6e-3, rng);
                let sources = vec![
                    Source {
                        sensor_m: [x - 2e-3, y],
                        energy_j: faint,
                    },
                    Source {
                        sensor_m: [x + 2e-3, y],
                        energy_j: ratio * faint,
                    },
                ];
                (expose(&camera, &sources, rng), sources)
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let counted = tally.share_counted();
            let remark = format!(
                "both seen in {:.0} %; {stray} of {clean} clean positions astray",
                100.0 * counted
            );
            let is_placed = stray <= false_alarms_allowed(options.frames);
            tally.observed(
                is_placed && counted >= 0.9 && clean * 10 >= 18 * options.frames,
                &remark,
            )
        },
    )
}

fn at_edge(past: f64) -> Case {
    let is_visible = past <= 2.0;
    Case::new(
        GROUP,
        format!("one {past} σ past the edge"),
        "part of the spot is cut off: position and energy trade against each other",
        if is_visible {
            "found, within 6 of its own σ"
        } else {
            "found, warned of or missed, but never placed wrongly without a warning"
        },
        move |options| {
            let camera = camera([32, 32], 1e-3);
            let tally = observe(options, &camera, |rng| {
                let y = anywhere(&camera, 3e-3, rng)[1];
                let source = Source {
                    sensor_m: [camera.x.half_width() + past * camera.spot_sigma_m, y],
                    energy_j: energy(&camera, 1e3),
                };
                (expose(&camera, &[source], rng), vec![source])
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let counted = tally.share_counted();
            let remark = format!(
                "seen in {:.0} %; {stray} of {clean} clean positions astray",
                100.0 * counted
            );
            let speaks_out = past > -1.0 || clean * 10 >= 9 * options.frames;
            let is_placed = stray <= false_alarms_allowed(options.frames);
            tally.observed(is_placed && speaks_out && (!is_visible || counted >= 0.9), &remark)
        },
    )
}

fn at_corner() -> Case {
    Case::new(
        GROUP,
        "one on the very corner",
        "three quarters of the spot are cut off",
        "found, within 6 of its own σ",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let source = Source {
                sensor_m: [-camera.x.half_width(), camera.y.half_width()],
                energy_j: energy(&camera, 1e3),
            };
            let tally = observe(options, &camera, |rng| (expose(&camera, &[source], rng), vec![source]));
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let remark = format!("{stray} of {clean} clean positions astray");
            let is_placed = stray <= false_alarms_allowed(options.frames);
            tally.observed(is_placed && tally.share_counted() >= 0.9, &remark)
        },
    )
}

fn nobody() -> Case {
    Case::new(GROUP, "nobody", "every peak is noise", "none found", |options| {
        let camera = camera([64, 64], 1e-3);
        let tally = observe(options, &camera, |rng| (expose(&camera, &[], rng), Vec::new()));
        let alarms = options.frames - (tally.share_counted() * options.frames as f64).round() as usize;
        let allowed = false_alarms_allowed(options.frames);
        tally.observed(alarms <= allowed, &format!("{alarms} false alarms"))
    })
}

fn faint() -> Case {
    Case::new(
        GROUP,
        "one of SNR 3",
        "below the threshold of detection as often as above",
        "found or missed; what is found is within 6 of its own σ or warned of",
        |options| {
            let camera = camera([32, 32], 1e-3);
            let tally = observe(options, &camera, |rng| {
                let source = Source {
                    sensor_m: anywhere(&camera, 0.0, rng),
                    energy_j: energy(&camera, 3.0),
                };
                (expose(&camera, &[source], rng), vec![source])
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            tally.observed(
                stray * 100 <= options.frames,
                &format!("{stray} of {clean} clean positions astray"),
            )
        },
    )
}

fn forty() -> Case {
    Case::new(
        GROUP,
        "forty",
        "120 unknowns; by chance several pairs nearer than 2σ",
        "no clean position in a hundred is astray",
        |options| {
            let camera = camera([64, 64], 5e-4);
            let tally = observe(options, &camera, |rng| {
                let sources: Vec<_> = (0..40)
                    .map(|_| Source {
                        sensor_m: anywhere(&camera, 5e-4, rng),
                        energy_j: energy(&camera, 300.0),
                    })
                    .collect();
                (expose(&camera, &sources, rng), sources)
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let remark = format!(
                "all forty in {:.0} %; {stray} of {clean} clean positions astray",
                100.0 * tally.share_counted()
            );
            tally.observed(stray * 100 <= clean, &remark)
        },
    )
}

fn line_of_five() -> Case {
    Case::new(
        GROUP,
        "five in a line, 0.7 σ apart",
        "their light is nearly that of fewer: wrong numbers fit well",
        "of a hundred positions no more than one is without a warning and yet off by more than 6 of its own σ",
        |options| {
            let camera = camera([32, 32], 1.5e-3);
            let tally = observe(options, &camera, |rng| {
                let [x, y] = anywhere(&camera, 6e-3, rng);
                let sources: Vec<_> = (-2..=2)
                    .map(|k| Source {
                        sensor_m: [x + 0.7 * f64::from(k) * camera.spot_sigma_m, y],
                        energy_j: energy(&camera, 1e3),
                    })
                    .collect();
                (expose(&camera, &sources, rng), sources)
            });
            let (clean, stray) = tally.strays(&camera, LIMIT, |t| t.iter().map(|s| s.sensor_m).collect());
            let all: usize = tally.estimates().map(|(_, e)| e.emitters.len()).sum();
            tally.observed(
                stray * 100 <= all,
                &format!("{clean} of {all} positions clean, {stray} of them astray"),
            )
        },
    )
}
