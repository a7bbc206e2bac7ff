#!/usr/bin/env python3
"""oapwatch on a real picture: stars and galaxies on a CCD, beside Source Extractor's detection.

Usage: real_picture.py OAPWATCH IMAGE.fits. Needs numpy, astropy and sep; the picture is data/image.fits of sep's source archive on
PyPI. oapwatch gets the pixels as they are, less their median, a width of 1.2 pixels and the noise, and no calibration. Prints a
Markdown table: of what sep finds at each threshold, how many oapwatch finds within 2.5 pixels, and how many of oapwatch's emitters
have an object of sep's there.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import sep
from astropy.io import fits

SIGMA_PIXELS, PITCH_M, NOISE_J = 1.2, 1e-4, 1e-6
ALTITUDE_M, PLANE_M = 300.0, 0.036
NEAR_PIXELS = 2.5
THRESHOLDS = (5.0, 3.0, 1.5, 1.0)


def located(program, frame):
    """Places in pixels, and the time, ms."""
    rows, columns = frame.shape
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        np.save(folder / "frame.npy", frame[None])
        (folder / "config.toml").write_text(
            f"[optics]\naltitude_m = {ALTITUDE_M}\nlens_radius_m = 0.05\nplane_distance_m = {PLANE_M}\n"
            f"pixels = [{columns}, {rows}]\nsensor_size_m = [{columns * PITCH_M}, {rows * PITCH_M}]\n"
            f"spot_sigma_m = {SIGMA_PIXELS * PITCH_M}\nnoise_std_j = {NOISE_J}\n"
        )
        arguments = [program, "locate", "--config", folder / "config.toml", folder / "frame.npy"]
        line = json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)
    places = np.array([[e["x_m"], e["y_m"]] for e in line["emitters"]])
    middle = [(columns - 1) / 2, (rows - 1) / 2]
    return places * PLANE_M / ALTITUDE_M / PITCH_M + middle, line["latency_us"] / 1e3


def main():
    picture = fits.getdata(sys.argv[2]).astype(float)
    background = sep.Background(picture)
    noise = background.globalrms
    places, ms = located(sys.argv[1], (picture - np.median(picture)) / noise * NOISE_J)
    peak = (picture.max() - np.median(picture)) / noise
    print(f"{len(places)} emitters in {ms:.0f} ms; the highest pixel is {peak:.0f} times the noise\n")
    print("| sep's threshold, σ | objects | of these found | emitters with an object |\n|---|---|---|---|")
    for threshold in THRESHOLDS:
        objects = sep.extract(picture - background.back(), threshold, err=noise)
        apart = np.hypot(*(places[:, None] - np.column_stack([objects["x"], objects["y"]])[None]).transpose(2, 0, 1))
        near = apart < NEAR_PIXELS
        print(f"| {threshold:g} | {len(objects)} | {near.any(0).sum()} | {near.any(1).sum()} of {len(places)} |")


if __name__ == "__main__":
    main()
