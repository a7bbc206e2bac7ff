//! One inference of a network by tract as the program runs it, and by onnxruntime, in turns of four and on one thread each:
//!
//!     cargo bench --bench network -- training/.venv/bin/python config/models/*.onnx
//!
//! Tenth percentiles (what the machine does when it is let), medians, 99th percentiles, and the ratio of the first. Without a Python that has onnxruntime, `-` leaves it out.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::time::Instant;

use tract_onnx::prelude::*;

/// As in the program: glibc's allocator gives tract's pages back and takes them again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const TURNS: usize = 500;
const TURN: usize = 4;
/// Prints the times, in µs, of as many inferences as each line of its input asks for.
const PEER: &str = "
import sys, time
import numpy, onnxruntime
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = options.inter_op_num_threads = 1
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=['CPUExecutionProvider'])
field = session.get_inputs()[0]
frame = {field.name: numpy.random.default_rng(1).random(field.shape, numpy.float32)}
session.run(None, frame)
for line in sys.stdin:
    times = []
    for _ in range(int(line)):
        began = time.perf_counter_ns()
        session.run(None, frame)
        times.append(str((time.perf_counter_ns() - began) / 1e3))
    print(' '.join(times), flush=True)
";

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let python = arguments.next().unwrap_or_else(|| "-".to_owned());
    println!("| network | tract 10th µs | median | 99th | onnxruntime 10th µs | median | 99th | ratio |");
    println!("|---|---|---|---|---|---|---|---|");
    for path in arguments {
        let model = onnx().model_for_path(&path).and_then(|m| m.into_optimized());
        let plan = model
            .and_then(|m| m.into_runnable())
            .expect("a network that tract can run");
        let fact = plan.model().input_fact(0).expect("an input").clone();
        let shape = fact.shape.as_concrete().expect("a static shape").to_vec();
        let values: Vec<f32> = (0..shape.iter().product()).map(|k| (k % 251) as f32 / 251.0).collect();
        let tract = || {
            let clock = Instant::now();
            let input = Tensor::from_shape(&shape, &values).expect("the model's own shape");
            let output = plan.run(tvec!(input.into())).expect("an inference");
            std::hint::black_box(output);
            clock.elapsed().as_secs_f64() * 1e6
        };
        let mut peer = (python != "-").then(|| {
            let mut child = Command::new(&python)
                .args(["-c", PEER, &path])
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
                .expect("a Python");
            let input = child.stdin.take().expect("piped");
            let output = BufReader::new(child.stdout.take().expect("piped"));
            (child, input, output)
        });
        tract();
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        for _ in 0..TURNS {
            ours.extend((0..TURN).map(|_| tract()));
            if let Some((_, input, output)) = &mut peer {
                writeln!(input, "{TURN}").expect("onnxruntime is there");
                let mut line = String::new();
                output.read_line(&mut line).expect("onnxruntime is there");
                theirs.extend(line.split_whitespace().map(|t| t.parse::<f64>().expect("a time")));
            }
        }
        if let Some((mut child, input, _)) = peer {
            drop(input);
            child.wait().expect("an end");
        }
        ours.sort_by(f64::total_cmp);
        theirs.sort_by(f64::total_cmp);
        let at = |times: &[f64], share: f64| times.get((times.len() as f64 * share) as usize).copied();
        let show = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.0}"));
        let ratio = at(&ours, 0.1).zip(at(&theirs, 0.1)).map(|(a, b)| a / b);
        let row = |times: &[f64]| [0.1, 0.5, 0.99].map(|share| show(at(times, share))).join(" | ");
        println!(
            "| {path} | {} | {} | {} |",
            row(&ours),
            row(&theirs),
            ratio.map_or("–".to_owned(), |r| format!("{r:.2}"))
        );
    }
}
