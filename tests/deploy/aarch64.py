#!/usr/bin/env python3
"""Runs the program built for aarch64 under QEMU beside the one built for this machine, on the same frames, and fails when their
positions differ by more than rounding. Usage: aarch64.py NATIVE CROSS [FRAMES].
"""

import json
import math
import pathlib
import re
import subprocess
import sys
import tempfile
import time

EMULATOR = ["qemu-aarch64-static", "-L", "/usr/aarch64-linux-gnu"]
# The order of floating-point operations differs (fused multiply-adds, vector widths), and a fit stops within its own tolerance:
# which is far below its standard deviation. The learned heatmap only starts the fit.
MOST_STDS = 0.01
SCENES = ["builtin", "paper-energy", "hazy-noon"]
ESTIMATORS = ["ml", "map", "hybrid"]

CONFIG = """
[estimator]
name = "{estimator}"
{known}
"""
KNOWN = "[estimator.known_power]\nenergies_j = [6.8e-3]\n"


def out(command, **options):
    done = subprocess.run(command, capture_output=True, text=True, **options)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))} ended with {done.returncode}: {done.stderr[-1000:]}")
    return done.stdout


def located(program, config, frames):
    began = time.monotonic()
    lines = out([*program, "locate", "--config", config, frames]).splitlines()
    return [json.loads(line) for line in lines], time.monotonic() - began


def difference(here, there):
    """Of two answers for a frame: the largest distance in m and in standard deviations; `None` where they differ in number."""
    if len(here["emitters"]) != len(there["emitters"]):
        return None
    worst = (0.0, 0.0)
    for e in here["emitters"]:
        distance = lambda other: math.hypot(e["x_m"] - other["x_m"], e["y_m"] - other["y_m"])
        nearest = min(map(distance, there["emitters"]))
        std = math.sqrt(max(e["cov_m2"][0][0] + e["cov_m2"][1][1], 1e-300))
        worst = max(worst[0], nearest), max(worst[1], nearest / std)
    return worst


def main():
    native, cross = [sys.argv[1]], [*EMULATOR, sys.argv[2]]
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 20
    root = pathlib.Path(__file__).parents[2]
    print("aarch64:", out([*cross, "--version"]).strip())
    print("aarch64:", out([*cross, "check", root / "config/default.toml"]).strip())
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for scene in SCENES:
            file = root / f"config/scenes/{scene}.toml"
            out([*native, "simulate", "--scene", file, "--frames", str(count), "--seed", "1", "--out", folder / scene])
            optics = re.search(r"(?ms)^\[optics\]$.*?(?=^\[|\Z)", file.read_text())
            optics = optics[0] if optics else ""
            for estimator in ESTIMATORS:
                config = folder / "config.toml"
                config.write_text(optics + CONFIG.format(estimator=estimator, known=KNOWN if estimator == "map" else ""))
                here, _ = located(native, config, folder / scene / "frames.npy")
                there, took = located(cross, config, folder / scene / "frames.npy")
                found = [difference(a, b) for a, b in zip(here, there, strict=True)]
                same = [f for f in found if f is not None]
                metres, stds = (max(f[k] for f in same) for k in (0, 1))
                beams = sum(len(line["emitters"]) for line in here)
                odd = len(found) - len(same)
                print(
                    f"{scene}, {estimator}: {len(here)} frames, {beams} beams; largest difference {metres:.1e} m, {stds:.1e} standard "
                    f"deviations; {odd} frames with another number of beams; {took / len(here):.1f} s a frame under emulation"
                )
                failed |= odd > 0 or stds > MOST_STDS
    sys.exit("the two differ" if failed else 0)


main()
