#!/usr/bin/env python3
"""oapwatch beside the finders and fitters that others use, on the same frames, one core each.

Usage: peers.py OAPWATCH [FRAMES]. Needs numpy, scipy, photutils, sep and trackpy. Prints a Markdown table: the median
squared error of matched emitters (within 25 m), its ratio to oapwatch's, the share of frames with the number of emitters
right, and the median time a frame. Every tool is told the spot's width and the noise; thresholds are at five sigma.
"""

import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time
import warnings

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
import numpy as np
import sep
import trackpy
from astropy.modeling.fitting import LMLSQFitter
from astropy.table import QTable
from photutils.detection import DAOStarFinder
from photutils.psf import GaussianPRF, IterativePSFPhotometry, SourceGrouper
from scipy.optimize import linear_sum_assignment

ALTITUDE_M, PLANE_M, SIDE_M = 300.0, 0.036, 0.03
CUTOFF_M = 25.0
SCENE = pathlib.Path(__file__).parent.parent / "config/scenes/paper.toml"
# Width of a spot, m, pixels a side, noise of a pixel, J.
CASES = [(1e-3, 64, 1e-6), (2e-3, 64, 1e-6)]


def photutils_fit(sigma, noise, model=None):
    """Peaks, then groups of overlapping spots fitted together, and residual peaks once more; by a Gaussian without `model`."""
    finder = DAOStarFinder(threshold=5 * noise / (2 * np.sqrt(np.pi) * sigma), fwhm=2.3548 * sigma)
    fit = IterativePSFPhotometry(
        model or GaussianPRF(x_fwhm=2.3548 * sigma, y_fwhm=2.3548 * sigma),
        fit_shape=2 * int(2.5 * sigma) + 1,
        finder=finder,
        grouper=SourceGrouper(3 * sigma),
        fitter=LMLSQFitter(),
        aperture_radius=2 * sigma,
        maxiters=2,
        progress_bar=False,
    )

    def run(frame):
        table = fit(frame, error=np.full_like(frame, noise))
        if table is None:
            return np.empty((0, 2))
        keep = table["flux_fit"] > 5 * 2 * np.sqrt(np.pi) * sigma * noise
        return np.column_stack([table["x_fit"][keep], table["y_fit"][keep]])

    return run


def sep_windowed(sigma, noise):
    """Source Extractor's detection with deblending, windowed centroids."""
    size = 2 * int(3 * sigma) + 1
    grid = np.arange(size) - size // 2
    kernel = np.exp(-(grid[:, None] ** 2 + grid[None, :] ** 2) / (2 * sigma**2))

    def run(frame):
        found = sep.extract(frame, 5.0, err=noise, filter_kernel=kernel, deblend_cont=1e-4)
        x, y, _ = sep.winpos(frame, found["x"], found["y"], np.full(len(found), sigma))
        return np.column_stack([x, y])

    return run


def trackpy_locate(sigma, noise):
    """Crocker and Grier's centroids, refined."""
    diameter = 2 * int(2 * sigma) + 1

    def run(frame):
        least = 5 * 2 * np.sqrt(np.pi) * sigma
        found = trackpy.locate(frame / noise, diameter, minmass=least, noise_size=1, threshold=1.0)
        return found[["x", "y"]].to_numpy()

    return run


def on_ground(pixels, n):
    """Pixel coordinates, a centre at its integer, to metres."""
    return ((pixels + 0.5) / n - 0.5) * SIDE_M * ALTITUDE_M / PLANE_M


def score(found, truth):
    """Squared errors of matched pairs, and whether the number is right."""
    if len(found) == 0:
        return [], len(truth) == 0
    squared = ((found[:, None] - truth[None]) ** 2).sum(2)
    rows, columns = linear_sum_assignment(np.minimum(squared, CUTOFF_M**2))
    pairs = [squared[r, c] for r, c in zip(rows, columns) if squared[r, c] < CUTOFF_M**2]
    return pairs, len(found) == len(truth)


def frames_of(program, folder, sigma_m, n, noise, frames):
    text = SCENE.read_text()
    for key, value in (("pixels", f"[{n}, {n}]"), ("spot_sigma_m", sigma_m), ("noise_std_j", noise)):
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    (folder / "scene.toml").write_text(text)
    arguments = ["--scene", folder / "scene.toml", "--frames", str(frames), "--seed", "3", "--out", folder]
    subprocess.run([program, "simulate", *arguments], check=True, capture_output=True)
    optics = re.search(r"(?ms)^\[optics\].*?(?=^\[)", text)[0]
    (folder / "config.toml").write_text(optics)
    return np.load(folder / "frames.npy").astype(float), truth_of(folder)


def truth_of(folder):
    """Positions of each frame's emitters, m."""
    lines = (folder / "truth.ndjson").read_text().splitlines()
    return [np.array([[e["x_m"], e["y_m"]] for e in json.loads(line)["emitters"]]) for line in lines]


def oapwatch(program, folder, estimator):
    arguments = ["locate", "--config", folder / "config.toml", "--estimator", estimator, folder / "frames.npy"]
    output = subprocess.run([program, *arguments], check=True, capture_output=True, text=True).stdout
    lines = [json.loads(line) for line in output.splitlines()]
    found = [np.array([[e["x_m"], e["y_m"]] for e in line["emitters"]]).reshape(-1, 2) for line in lines]
    return found, [line["latency_us"] for line in lines]


def row(name, found, truth, times, best=None):
    scores = [score(f, t) for f, t in zip(found, truth)]
    median = statistics.median([p for pairs, _ in scores for p in pairs] or [float("nan")])
    right = sum(is_right for _, is_right in scores) / len(scores)
    error, micros = best or (median, statistics.median(times))
    print(
        f"| {name} | {median:.2e} | {median / error:.3g} | {100 * right:.1f} % |"
        f" {statistics.median(times):.0f} | {statistics.median(times) / micros:.3g} |",
        flush=True,
    )
    return error, micros


def main():
    program = sys.argv[1]
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 100
    warnings.simplefilter("ignore")
    trackpy.quiet()
    for sigma_m, n, noise in CASES:
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            frames, truth = frames_of(program, folder, sigma_m, n, noise, count)
            print(f"\n## σ_eff {1e3 * sigma_m:g} mm, {n}×{n}, σ_n {noise:g} J, five to nine emitters, {count} frames\n")
            print("| program | median m² | over ml's | N right | µs a frame | over ml's |\n|---|---|---|---|---|---|")
            found, times = oapwatch(program, folder, "ml")
            best = row("oapwatch `ml`", found, truth, times)
            for estimator in ("greedy-fit", "peak-fit"):
                found, times = oapwatch(program, folder, estimator)
                row(f"oapwatch `{estimator}`", found, truth, times, best)
            sigma = sigma_m / SIDE_M * n
            for name, make in (
                ("photutils, iterative PSF fit", photutils_fit),
                ("sep, windowed centroids", sep_windowed),
                ("trackpy, refined centroids", trackpy_locate),
            ):
                run = make(sigma, noise)
                found, times = [], []
                for frame in frames:
                    began = time.perf_counter()
                    places = run(np.ascontiguousarray(frame))
                    times.append(1e6 * (time.perf_counter() - began))
                    found.append(on_ground(places, n))
                row(name, found, truth, times, best)


if __name__ == "__main__":
    main()
