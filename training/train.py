"""Trains one network on the simulator's samples; takes up where it was left. `train.sh` trains them all."""

import argparse
import json
import math
import os
import time
from pathlib import Path

import torch
from torch.nn import functional
from tqdm import tqdm

from networks import NETWORKS, build, normalise
from samples import Stream, Streams, heatmaps, offsets

VALIDATION = 256
VALIDATION_SEED = 2
TRAINING_SEED = 1
# Samples that a whitening front is learned from.
WHITENING = 2000
# Share of the training in which the learning rate rises.
WARM_UP = 0.05


def loss_of(output, frames, emitters, sigma_px):
    """Hybrid: MSE against the heatmap. U-Net: 1·squared offset error where there is light + 0.5·BCE."""
    ny, nx = frames.shape[2:]
    target = heatmaps(emitters, ny, nx, sigma_px)
    if not isinstance(output, tuple):
        return functional.mse_loss(output, target)
    heatmap, coordinates = output
    near = target > 0.3
    error = ((coordinates - offsets(emitters, ny, nx)) ** 2 * near).sum() / near.sum().clamp_min(1)
    return error + 0.5 * functional.binary_cross_entropy(heatmap, target)


def peaks(output, threshold=0.3, radius=1):
    """What the program makes of a network's output: for each frame (count, 2), columns and rows in pixels.

    Maxima of the heatmap within `radius` pixels and above `threshold`, moved by the coordinate head where there is one and else
    to the vertex of the parabola through the logarithms of the neighbours along each axis, exact for a Gaussian.
    """
    heatmap, coordinates = output if isinstance(output, tuple) else (output, None)
    largest = functional.max_pool2d(heatmap, 2 * radius + 1, stride=1, padding=radius)
    frame, _, row, column = torch.nonzero((heatmap == largest) & (heatmap > threshold), as_tuple=True)
    if coordinates is not None:
        move = coordinates[frame, :, row, column].clamp(-radius, radius)
    else:
        height = functional.pad(heatmap, (1, 1, 1, 1)).clamp_min(1e-6).log()[:, 0]
        at = [[height[frame, row + 1 + dy * k, column + 1 + dx * k] for k in (-1, 0, 1)] for dx, dy in ((1, 0), (0, 1))]
        curved = [(a - 2 * b + c).clamp_max(-1e-6) for a, b, c in at]
        move = torch.stack([(0.5 * (a - c) / k).clamp(-0.5, 0.5) for (a, b, c), k in zip(at, curved)], dim=1)
    found = torch.stack([column, row], dim=1) + move
    return [found[frame == k] for k in range(len(heatmap))]


def validate(network, batches, sigma_px, metre_px, device):
    """Loss, and what the heatmaps' maxima alone are worth within 10 m: recall, precision, median and mean squared error, m²."""
    network.eval()
    losses, found, total, named, squared = [], 0, 0, 0, []
    with torch.no_grad():
        for frames, emitters in batches:
            output = network(normalise(frames.to(device)))
            output = tuple(o.cpu() for o in output) if isinstance(output, tuple) else output.cpu()
            losses.append(loss_of(output, frames, emitters, sigma_px).item())
            for at, slots in zip(peaks(output), emitters):
                truth = slots[~slots[:, 0].isnan(), :2]
                total += len(truth)
                named += len(at)
                if len(at):
                    # Nearest peak of each emitter: the program's own studies match one to one.
                    distance = torch.cdist(truth, at).amin(1) * metre_px
                    found += int((distance < 10.0).sum())
                    squared += (distance[distance < 10.0] ** 2).tolist()
    network.train()
    return {
        "loss": sum(losses) / len(losses),
        "recall_10m": found / total,
        "precision_10m": min(found, named) / max(named, 1),
        "median_squared_error_m2": sorted(squared)[len(squared) // 2] if squared else math.nan,
        "mean_squared_error_m2": sum(squared) / len(squared) if squared else math.nan,
    }


def device_of(name: str) -> torch.device:
    """`auto` is a GPU where there is one."""
    if name == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: expected a GPU that PyTorch can use, found none")
    has_gpu = name != "cpu" and torch.cuda.is_available()
    return torch.device("cuda" if has_gpu else "cpu")


def has_bf16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities()
    return bool(able.get("avx512_bf16") or able.get("amx_bf16"))


def machine_of(device: torch.device, threads: int) -> str:
    if device.type == "cuda":
        return f"one {torch.cuda.get_device_name(device)}"
    return "one processor core" if threads == 1 else f"{threads} processor cores"


def save(path: Path, state: dict) -> None:
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", choices=NETWORKS, required=True)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/oapwatch"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint and the validation curve")
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="time of the whole training (of the processor, or by the clock beside a GPU), whatever the number of samples; the schedule heeds it"
    )
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--rate", type=float, default=3e-3, help="largest learning rate; falls as a cosine to nothing")
    parser.add_argument("--devices", type=int, default=1, help="that samples are spread over, each with gains of its own")
    parser.add_argument("--width-std", type=float, default=0.0, help="relative scatter of the spot's width from device to device")
    parser.add_argument("--target-sigma-px", type=float, default=0.7)
    parser.add_argument("--target-sigma-m", type=float, default=0.0, help="no narrower than this on the ground: a heatmap has no maximum where it is less certain")
    parser.add_argument("--from-run", type=Path, help="begin with the weights of another run of the same network")
    parser.add_argument(
        "--precision", choices=("auto", "bf16", "f32"), default="auto", help="of the convolutions while training; bf16 where the device has instructions for it, which are emulated elsewhere at a ninth of the speed"
    )
    parser.add_argument("--validations", type=int, default=10, help="how often to validate and keep a checkpoint")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--processes", type=int, help="that make samples; one beside a processor, those of the machine beside a GPU")
    args = parser.parse_args()

    device = device_of(args.device)
    processes = args.processes or (max(1, (os.cpu_count() or 2) - 2) if device.type == "cuda" else 1)
    is_bf16 = args.precision == "bf16" or (args.precision == "auto" and has_bf16(device))
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    args.out.mkdir(parents=True, exist_ok=True)

    scatter = ["--devices", str(args.devices), "--width-std", str(args.width_std)]
    held_out = Stream(args.program, args.scene, VALIDATION, 0, VALIDATION_SEED, scatter)
    layout = held_out.layout
    validation = list(held_out.batches(32))
    held_out.close()
    metre_px = layout["ground_m_per_px"][0]
    target_sigma_px = max(args.target_sigma_px, args.target_sigma_m / metre_px)

    network = build(args.network, layout["nx"], layout["ny"]).to(device, memory_format=torch.channels_last)
    optimiser = torch.optim.Adam(network.parameters(), lr=args.rate)
    seen, curve, spent = 0, [], 0.0
    checkpoint = args.out / "checkpoint.pt"
    if checkpoint.exists():
        state = torch.load(checkpoint, map_location=device)
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        seen, curve, spent = state["seen"], state["curve"], state["seconds"]
    else:
        if args.from_run:
            network.body.load_state_dict(torch.load(args.from_run / "checkpoint.pt", map_location=device)["body"])
        if args.network.endswith("-white"):
            first = Stream(args.program, args.scene, WHITENING, 0, TRAINING_SEED, scatter)
            network.front.learn(next(first.batches(WHITENING))[0].to(device))
            first.close()
    about = {"name": args.network, "target_sigma_px": target_sigma_px, "layout": layout}
    about["machine"] = machine_of(device, args.threads)
    # A processor's time leaves out what else the machine does; a GPU has no such clock.
    clock = time.monotonic if device.type == "cuda" else time.process_time
    began = clock() if device.type == "cuda" else 0.0
    about["from_run"] = args.from_run and args.from_run.name

    def seconds():
        return spent + clock() - began

    def progress():
        return min(1.0, max(seen / args.samples, seconds() / 60 / args.minutes))

    def keep():
        at = seconds()
        curve.append({"samples": seen, "seconds": round(at), **validate(network, validation, target_sigma_px, metre_px, device)})
        bar.write(json.dumps(curve[-1]))
        state = {"network": network.state_dict(), "body": network.body.state_dict(), "optimiser": optimiser.state_dict()}
        save(checkpoint, {**state, "seen": seen, "curve": curve, "seconds": at, **about})
        (args.out / "curve.json").write_text(json.dumps(curve, indent=1))

    if progress() >= 1.0:
        print(f"{args.out} is trained: {seen} samples in {spent:.0f} s")
        return
    stream = Streams(args.program, args.scene, seen, args.samples, TRAINING_SEED, processes, scatter)
    bar = tqdm(total=args.samples, initial=seen, unit="sample", smoothing=0.05, mininterval=1.0)
    done = kept = progress()
    for frames, emitters, is_leg in stream.batches(args.batch):
        if device.type == "cuda":
            frames, emitters = (batch.pin_memory().to(device, non_blocking=True) for batch in (frames, emitters))
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1.0, done / WARM_UP + 0.05) * 0.5 * (1 + math.cos(math.pi * done))
        optimiser.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=is_bf16):
            output = network(normalise(frames).contiguous(memory_format=torch.channels_last))
        loss = loss_of(output, frames, emitters, target_sigma_px)
        loss.backward()
        optimiser.step()
        seen += len(frames)
        done = progress()
        bar.update(len(frames))
        bar.set_postfix(loss=f"{loss.item():.2e}", done=f"{100 * done:.0f} %")
        # What is kept between two legs can be taken up without a sample twice or never.
        is_due = int(done * args.validations) > int(kept * args.validations)
        if done >= 1.0 or (is_leg and is_due):
            keep()
            kept = done
        if done >= 1.0:
            break
    stream.close()
    bar.close()


if __name__ == "__main__":
    main()
