"""Writes the scene that a network for one's own lens is trained on: the device of a config with its calibration's spot, in the light of
another scene. Prints the width's relative scatter from device to device, σ_eff in pixels, and a name of its own for the scene."""

import argparse
import hashlib
import json
import re
import tomllib
from pathlib import Path

GEOMETRY = ("altitude_m", "lens_radius_m", "plane_distance_m", "pixels", "sensor_size_m")
# Relative scatter of gains that a calibration without and with pixel maps leaves.
GAIN_STD = (0.01, 0.002)
# Relative scatter of the width where a calibration states no spot error.
WIDTH_STD = 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="names its calibration in [optics]")
    parser.add_argument("--light", type=Path, required=True, help="the scene whose emitters, link and noise are used")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()

    optics = tomllib.loads(args.config.read_text()).get("optics", {})
    if "calibration" not in optics:
        raise SystemExit(f"{args.config}: optics.calibration: expected the file that `oapwatch calibrate` wrote, found none")
    file = (args.config.parent / optics["calibration"]).resolve()
    calibration = tomllib.loads(file.read_text())
    spot = calibration["spot"]
    missing = [key for key in GEOMETRY if key not in optics]
    if missing:
        raise SystemExit(f"{args.config}: optics: expected {', '.join(missing)}, found none")

    light = args.light.read_text()
    head, rest = light.split("[optics]")
    noise = tomllib.loads(light)["optics"]["noise_std_j"]
    rest = rest[rest.index("\n[") + 1 :]
    view = [side / optics["plane_distance_m"] * optics["altitude_m"] for side in optics["sensor_size_m"]]
    rest = re.sub(r"(?m)^area_m = .*$", f"area_m = {view}", rest)
    lines = [f"{key} = {json.dumps(optics[key])}" for key in GEOMETRY]
    lines += [f"spot_sigma_m = {spot['sigma_m']}", f"noise_std_j = {noise}"]
    scene = f"{head}[optics]\n" + "\n".join(lines) + f"\n\n{rest}gain = {{ std = {GAIN_STD['pixels' in calibration]} }}\n"
    if "shape" in spot:
        scene += f'spot = {{ kind = "calibration", file = {json.dumps(str(file))} }}\n'
    args.out.write_text(scene)
    pitch = min(size / pixels for size, pixels in zip(optics["sensor_size_m"], optics["pixels"]))
    name = hashlib.sha256((scene + file.read_text()).encode()).hexdigest()[:12]
    print(spot.get("error") or WIDTH_STD, spot["sigma_m"] / pitch, name)


if __name__ == "__main__":
    main()
