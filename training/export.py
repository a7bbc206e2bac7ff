"""Writes a trained network as ONNX with static shapes (batch normalisation is folded into the convolutions) and its card."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from networks import FLOOR_SIGMA, NETWORKS, normalise
from samples import Stream
from train import VALIDATION_SEED

# Largest file that the repository takes.
LIMIT_BYTES = 8_000_000


class Deployed(torch.nn.Module):
    """The heatmap alone; the U-Net's coordinates are for training."""

    def __init__(self, network: torch.nn.Module):
        super().__init__()
        self.network = network

    def forward(self, frame: torch.Tensor) -> torch.Tensor:
        output = self.network(frame)
        return output[0] if isinstance(output, tuple) else output


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True, help="folder of checkpoint.pt")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/oapwatch"))
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file; the card goes beside it")
    parser.add_argument("--reference", type=Path, help="also write a frame and onnxruntime's heatmap of it, f4, here")
    args = parser.parse_args()

    state = torch.load(args.run / "checkpoint.pt", map_location="cpu")
    network = NETWORKS[state["name"]]()
    network.load_state_dict(state["network"])
    deployed = Deployed(network).eval()
    nx, ny = state["layout"]["nx"], state["layout"]["ny"]
    example = torch.rand(1, 1, ny, nx)
    torch.onnx.export(
        deployed, (example,), args.out, input_names=["frame"], output_names=["heatmap"],
        opset_version=17, dynamo=False, do_constant_folding=True,
    )
    data = args.out.read_bytes()
    if len(data) > LIMIT_BYTES:
        args.out.unlink()
        raise SystemExit(f"{args.out} would be {len(data)} bytes, more than {LIMIT_BYTES}; it was not kept")

    stream = Stream(args.program, args.scene, 1, 0, VALIDATION_SEED)
    frame, _ = next(stream.batches(1))
    stream.close()
    frame = normalise(frame)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    (heatmap,) = session.run(None, {"frame": frame.numpy()})
    difference = np.abs(heatmap - deployed(frame).detach().numpy()).max()
    if difference > 1e-5:
        raise SystemExit(f"onnxruntime and PyTorch differ by {difference}")
    if args.reference:
        np.save(args.reference, np.stack([frame.numpy()[0, 0], heatmap[0, 0]]).astype("<f4"))

    layout = state["layout"]
    best = state["curve"][-1]
    args.out.with_suffix(".toml").write_text(
        f"""# Card of {args.out.name}; the program checks the sum and the shape before it uses the network.
network = "{state['name']}"
sha256 = "{hashlib.sha256(data).hexdigest()}"
shape = [{ny}, {nx}]              # Ny, Nx
# Input: energies over the frame's maximum, but at least over this many times noise_std_j.
floor_sigma = {FLOOR_SIGMA}
target_sigma_px = {state['target_sigma_px']}
# What it was trained on. On other widths and noises it was never tried.
scene = "{layout['scene']}"
spot_sigma_px = {layout['spot_sigma_px'][0]}
noise_std_j = {layout['noise_std_j']}
samples = {state['seen']}
training_seconds = {state['seconds']:.0f}

# 512 frames of another seed. Squared error: of peaks within 10 m, heatmap maxima with a 3 × 3 centroid.
[validation]
loss = {best['loss']:.6g}
recall_10m = {best['recall_10m']:.5f}
median_squared_error_m2 = {best['median_squared_error_m2']:.5g}
"""
    )
    print(json.dumps({"file": str(args.out), "bytes": len(data), "difference_to_pytorch": float(difference)}))


if __name__ == "__main__":
    main()
