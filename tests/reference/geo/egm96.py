"""Writes src/geo/egm96.bin: undulations of EGM96 on a half-degree grid, and reference points between its nodes.

The coefficients are those of the NGA's F477 program (EGM96 to degree 360, and the correction from height anomaly to undulation), as the
crate `egm96` 0.3.2 on crates.io ships them in data/coefficients.txt: a line of (correction C, S; potential C, S) for each degree n and
order m. The synthesis is that of F477 (Rapp 1982, report 334; Lemoine et al. 1998, NASA/TP-1998-206861, ch. 11).

    python3 egm96.py COEFFICIENTS.txt
"""

import struct
import sys
from pathlib import Path

import numpy as np

DEGREE = 360
STEP_DEG = 0.5
HERE = Path(__file__).resolve().parent


def load(path):
    rows = [line.strip().rstrip(",").strip("[]").split(",") for line in open(path) if line.strip()]
    table = np.array(rows, dtype=float)[1:]  # the first line is padding
    fields = np.zeros((4, DEGREE + 1, DEGREE + 1))
    k = 0
    for n in range(DEGREE + 1):
        fields[:, n, : n + 1] = table[k : k + n + 1].T
        k += n + 1
    return fields


def legendre(theta):
    """Fully normalised associated Legendre functions, (n, m)."""
    p = np.zeros((DEGREE + 1, DEGREE + 1))
    c, s = np.cos(theta), np.sin(theta)
    p[0, 0] = 1.0
    p[1, 1] = np.sqrt(3.0) * s
    for n in range(2, DEGREE + 1):
        p[n, n] = np.sqrt((2 * n + 1) / (2 * n)) * s * p[n - 1, n - 1]
    for n in range(1, DEGREE + 1):
        m = np.arange(n)
        a = np.sqrt((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m)))
        p[n, :n] = a * c * p[n - 1, :n]
        if n > 1:
            k = m[: n - 1]
            b = np.sqrt((2 * n + 1) * (n + k - 1) * (n - k - 1) / ((n - k) * (n + k) * (2 * n - 3)))
            p[n, : n - 1] -= b * p[n - 2, : n - 1]
    return p


def undulations(fields, latitude_deg, longitudes_deg):
    lat = np.radians(latitude_deg)
    a, e2, gm = 6378137.0, 0.00669437999013, 0.3986004418e15
    t = np.sin(lat) ** 2
    n = a / np.sqrt(1 - e2 * t)
    x, z = n * np.cos(lat), n * (1 - e2) * np.sin(lat)
    radius = np.hypot(x, z)
    gravity = 9.7803253359 * (1 + 0.00193185265246 * t) / np.sqrt(1 - e2 * t)
    p = legendre(np.pi / 2 - np.arctan2(z, x))
    degrees = np.arange(DEGREE + 1)
    ratio = (a / radius) ** degrees
    ratio[:2] = 0.0
    correction_c, correction_s, potential_c, potential_s = fields
    along = gm / (gravity * radius) * ratio[:, None] * p
    cos = (along * potential_c + p * correction_c / 100).sum(0)
    sin = (along * potential_s + p * correction_s / 100).sum(0)
    angles = np.radians(np.asarray(longitudes_deg))[:, None] * degrees
    return np.cos(angles) @ cos + np.sin(angles) @ sin - 0.53


def main():
    fields = load(sys.argv[1])
    longitudes = np.arange(0, 360, STEP_DEG)
    latitudes = np.arange(90, -90 - STEP_DEG / 2, -STEP_DEG)
    rows = [undulations(fields, latitude, longitudes) for latitude in latitudes]
    grid = np.round(100 * np.array(rows)).astype(">i2")
    (HERE / "../../../src/geo/egm96.bin").write_bytes(grid.tobytes())
    random = np.random.default_rng(1)
    with open(HERE / "egm96.csv", "w") as out:
        out.write("latitude_deg,longitude_deg,undulation_m\n")
        for _ in range(400):
            latitude = np.degrees(np.arcsin(random.uniform(-1, 1)))
            longitude = random.uniform(-180, 180)
            value = undulations(fields, latitude, [longitude])[0]
            out.write(f"{latitude:.6f},{longitude:.6f},{value:.4f}\n")


if __name__ == "__main__":
    main()
