#!/usr/bin/env python3
"""oapwatch beside photutils on spots that no lens makes Gaussian: both learn the spot from the same frames without positions.

Usage: lens_peers.py OAPWATCH [FRAMES]. Needs numpy, scipy, sep, trackpy and photutils. photutils builds an effective PSF (Anderson and
King, 2000) from the five brightest peaks of each frame of the calibration, and fits with it by iterative PSF photometry. Prints a
Markdown table as peers.py does, on frames with five spots apart.
"""

import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
import warnings

import numpy as np
import peers
from astropy.nddata import NDData
from astropy.table import Table
from photutils.detection import DAOStarFinder
from photutils.psf import EPSFBuilder, EPSFStars, extract_stars

PIXELS, SIGMA_M, NOISE_J = 64, 7.5e-4, 1e-6
SIGMA = SIGMA_M / peers.SIDE_M * PIXELS
CALIBRATION_FRAMES = 150
# Widths as the best Gaussian's.
LENSES = [
    ("Airy disc", 'kind = "airy"\nfirst_zero_m = 2.2e-3'),
    ("Moffat, β 2.5", 'kind = "moffat"\ncore_m = 1.55e-3\nindex = 2.5'),
    ("defocus disc", 'kind = "defocus"\nradius_m = 1.35e-3\nblur_m = 2e-4'),
]
# Pixels of a star's cutout, and pixels of the effective PSF a pixel.
CUTOUT, OVERSAMPLING = 25, 2


def scene(spot, power_w):
    """Five who wander, 60 m and more apart, ten frames a second."""
    optics = (
        f"altitude_m = {peers.ALTITUDE_M}\nlens_radius_m = 0.05\nplane_distance_m = {peers.PLANE_M}\n"
        f"pixels = [{PIXELS}, {PIXELS}]\nsensor_size_m = [{peers.SIDE_M}, {peers.SIDE_M}]\n"
        f"spot_sigma_m = {SIGMA_M}\nnoise_std_j = {NOISE_J}\n"
    )
    homes = [(-70, -70), (70, -70), (0, 0), (-70, 70), (70, 70)]
    users = "".join(
        f'[[user]]\nname = "u-{k}"\nmotion.roam = {{ home_m = [{x}, {y}], spread_m = 8, time_s = 2 }}\n'
        for k, (x, y) in enumerate(homes)
    )
    return optics, (
        f"rate_hz = 10.0\n[optics]\n{optics}[link]\npower_w = {power_w}\nintegration_time_s = 0.1\n"
        f"[effects]\nfading = {{ alpha = 4.0, beta = 2.0 }}\nthermal_noise = {{}}\n[effects.spot]\n{spot}\n{users}"
    )


def simulate(program, folder, spot, power_w, frames, seed):
    optics, text = scene(spot, power_w)
    folder.mkdir()
    (folder / "scene.toml").write_text(text)
    (folder / "config.toml").write_text(f"[optics]\n{optics}")
    arguments = ["--scene", folder / "scene.toml", "--frames", str(frames), "--seed", str(seed), "--out", folder]
    subprocess.run([program, "simulate", *arguments], check=True, capture_output=True)
    return np.load(folder / "frames.npy").astype(float), peers.truth_of(folder)


def found_peaks(frame):
    threshold = 20 * NOISE_J / (2 * np.sqrt(np.pi) * SIGMA)
    table = DAOStarFinder(threshold=threshold, fwhm=2.3548 * SIGMA, min_separation=4 * SIGMA)(frame)
    names = ("x_centroid", "y_centroid")
    return [] if table is None else sorted(zip(table["flux"], table[names[0]], table[names[1]]), reverse=True)[:5]


def effective_psf(frames):
    stars = []
    for frame in frames:
        peaks = found_peaks(frame)
        table = Table({"x": [p[1] for p in peaks], "y": [p[2] for p in peaks]})
        stars.extend(extract_stars(NDData(frame), table, size=CUTOUT).all_stars)
    builder = EPSFBuilder(oversampling=OVERSAMPLING, maxiters=10, progress_bar=False)
    return builder(EPSFStars(stars))[0], len(stars)


def main():
    program = sys.argv[1]
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 40
    warnings.simplefilter("ignore")
    for name, spot in LENSES:
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            learning, _ = simulate(program, folder / "learning", spot, 1.0, CALIBRATION_FRAMES, 1)
            frames, truth = simulate(program, folder / "frames", spot, 1.0, count, 2)
            peak = statistics.median(frame.max() for frame in frames) / NOISE_J
            print(f"\n## {name}, peak SNR {peak:.0f}, {PIXELS}×{PIXELS}, {count} frames, learned from {CALIBRATION_FRAMES}\n")
            print("| program | median m² | over ml's | N right | µs a frame | over ml's |\n|---|---|---|---|---|---|")
            config, calibration = folder / "learning/config.toml", folder / "frames/calibration.toml"
            began = time.perf_counter()
            learn = [program, "calibrate", "--config", config, "--out", calibration, folder / "learning/frames.npy"]
            subprocess.run(learn, check=True, capture_output=True)
            learned_s = time.perf_counter() - began
            uncalibrated = peers.oapwatch(program, folder / "frames", "ml")
            with (folder / "frames/config.toml").open("a") as file:
                file.write('calibration = "calibration.toml"\n')
            found, times = peers.oapwatch(program, folder / "frames", "ml")
            best = peers.row("oapwatch `ml`, calibrated", found, truth, times)
            peers.row("oapwatch `ml`, not calibrated", *uncalibrated[:1], truth, uncalibrated[1], best)
            began = time.perf_counter()
            model, stars = effective_psf(learning)
            built_s = time.perf_counter() - began
            run = peers.photutils_fit(SIGMA, NOISE_J, model)
            found, times = [], []
            for frame in frames:
                began = time.perf_counter()
                places = run(frame)
                times.append(1e6 * (time.perf_counter() - began))
                found.append(peers.on_ground(places, PIXELS))
            peers.row("photutils, effective PSF, iterative", found, truth, times, best)
            print(f"\nLearned in {learned_s:.1f} s (oapwatch) and {built_s:.1f} s (photutils, {stars} stars).", flush=True)


if __name__ == "__main__":
    main()
