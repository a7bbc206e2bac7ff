//! What a frame costs: bare, with the paper's effects, with noise; that an effect which is not called for costs nothing; and
//! what more threads bring in bulk.

mod timing;

use oapwatch::scene::{Plan, Scene};
use rayon::ThreadPoolBuilder;
use timing::time;

/// Nine emitters that stand on a grid, 64 × 64 pixels, σ_eff 1 mm.
fn nine(effects: &str) -> Plan {
    let emitters = (0..9).map(|k| {
        let at = [80 * (k % 3 - 1), 80 * (k / 3 - 1)];
        format!("[[intruder]]\nname = \"e{k}\"\nmotion.still = {at:?}\n")
    });
    let text = format!("{}[effects]\n{effects}", emitters.collect::<String>());
    let scene: Scene = toml::from_str(&text).expect("the scene is well formed");
    Plan::compile(&scene, 1).expect("the scene is sound")
}

const LINK: &str =
    "attenuation = { kappa_per_m = 0.001 }\nfading = { alpha = 4, beta = 2 }\npointing = { jitter_m = 0.1 }\n";

fn frames() {
    let noise = "thermal_noise = {}\n";
    let tolerated = "shot_noise = { wavelength_m = 1.55e-6 }\n";
    for (name, effects) in [
        ("no effect", String::new()),
        ("the paper's link", LINK.to_owned()),
        (
            "the paper's link, every fade drawn",
            format!("{LINK}fading = {{ cn2 = 1e-13, wavelength_m = 1.55e-6 }}\n").replacen(
                "fading = { alpha = 4, beta = 2 }\n",
                "",
                1,
            ),
        ),
        ("the paper's link and noise", format!("{LINK}{noise}")),
        (
            "the paper's link, noise and shot noise",
            format!("{LINK}{noise}{tolerated}"),
        ),
    ] {
        let plan = nine(&effects);
        let mut maker = plan.maker();
        let mut k = 0;
        time(&format!("frame, 64 × 64, N = 9: {name}"), || {
            k += 1;
            maker.frame(k)
        });
    }
}

/// As many frames as `oapwatch simulate` holds at a time.
const BULK: u64 = 256;

fn bulk() {
    let plan = nine(&format!("{LINK}thermal_noise = {{}}\n"));
    let all = std::thread::available_parallelism().map_or(1, usize::from);
    for threads in [1, all] {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let name = format!("{BULK} frames, 64 × 64, N = 9, link and noise: {threads} threads");
        time(&name, || pool.install(|| plan.frames(0, BULK)));
    }
}

fn main() {
    frames();
    bulk();
}
