"""Writes a trained network as ONNX with static shapes (batch normalisation is folded into the convolutions) and its card."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from networks import FLOOR_SIGMA, build, normalise
from samples import Stream
from train import VALIDATION, VALIDATION_SEED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="folder of checkpoint.pt")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/oapwatch"))
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file; the card goes beside it")
    parser.add_argument("--reference", type=Path, help="also write a frame and onnxruntime's heatmap of it, f4, here")
    args = parser.parse_args()

    state = torch.load(args.run / "checkpoint.pt", map_location="cpu")
    layout = state["layout"]
    nx, ny = layout["nx"], layout["ny"]
    network = build(state["name"], nx, ny).eval()
    network.load_state_dict(state["network"])
    example = torch.rand(1, 1, ny, nx)
    outputs = ["heatmap", "offsets"][: 2 if isinstance(network(example), tuple) else 1]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        network, (example,), args.out, input_names=["frame"], output_names=outputs, opset_version=17, dynamo=False, do_constant_folding=True
    )
    data = args.out.read_bytes()

    stream = Stream(args.program, args.scene, 1, 0, VALIDATION_SEED)
    frame, _ = next(stream.batches(1))
    stream.close()
    frame = normalise(frame)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    found = session.run(None, {"frame": frame.numpy()})
    with torch.no_grad():
        expected = network(frame)
    expected = expected if isinstance(expected, tuple) else (expected,)
    difference = max(float(np.abs(a - b.numpy()).max()) for a, b in zip(found, expected))
    # Whitening lifts what lies at the noise, some 10⁻⁴ of a frame, to the size of the rest, and float32's rounding with it.
    if difference > (1e-2 if state["name"].endswith("-white") else 1e-4):
        raise SystemExit(f"onnxruntime and PyTorch differ by {difference}")
    if args.reference:
        np.save(args.reference, np.stack([frame.numpy()[0, 0], found[0][0, 0]]).astype("<f4"))

    best = state["curve"][-1]
    begun = f'\nbegun_from = "{state["from_run"]}"' if state.get("from_run") else ""
    args.out.with_suffix(".toml").write_text(
        f"""# Card of {args.out.name}; the program checks the sum and the shape before it uses the network.
network = "{state["name"]}"
sha256 = "{hashlib.sha256(data).hexdigest()}"
shape = [{ny}, {nx}]              # Ny, Nx
# Input: energies over the frame's maximum, but at least over this many times noise_std_j.
floor_sigma = {FLOOR_SIGMA}
target_sigma_px = {state["target_sigma_px"]}
# What it was trained on. On other widths and noises it was never tried.
scene = "{layout["scene"]}"
spot_sigma_px = {layout["spot_sigma_px"][0]}
noise_std_j = {layout["noise_std_j"]}
samples = {state["seen"]}
training_seconds = {state["seconds"]:.0f}
trained_on = "{state.get("machine", "one processor core")}"{begun}

# {VALIDATION} frames of another seed: heatmap maxima, held to the nearest emitter within 10 m.
[validation]
loss = {best["loss"]:.6g}
recall_10m = {best["recall_10m"]:.5f}
precision_10m = {best["precision_10m"]:.5f}
median_squared_error_m2 = {best["median_squared_error_m2"]:.5g}
mean_squared_error_m2 = {best["mean_squared_error_m2"]:.5g}
"""
    )
    print(json.dumps({"file": str(args.out), "bytes": len(data), "difference_to_pytorch": difference}))


if __name__ == "__main__":
    main()
