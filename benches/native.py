#!/usr/bin/env python3
"""What a build for this very processor gains over the packaged one.

Usage: native.py PACKAGED NATIVE [TURNS]. Both run the same cells of the trade-off in turns; prints the median of the turns'
median times a frame and their ratio, one row a cell and estimator.
"""

import json
import pathlib
import statistics
import subprocess
import sys
import tempfile

CELLS = ["E1/64", "E2/64", "E4/64", "P8/60", "E1/100 N=20"]
ESTIMATORS = ["subpixel-peak", "pencil-fit", "ml"]


def name(cell):
    emitters = f" N={cell['emitters']}" if cell["emitters"] else ""
    return f"{cell['noise'][0].upper()}{cell['sigma_mm']:g}/{cell['pixels']}{emitters}"


def study(program):
    with tempfile.TemporaryDirectory() as folder:
        chosen = ["--cells", ",".join(CELLS), "--estimators", ",".join(ESTIMATORS)]
        command = [program, "tradeoff", "--out", folder, "--frames", "40", *chosen]
        subprocess.run(command, check=True, capture_output=True)
        return json.loads((pathlib.Path(folder) / "tradeoff.json").read_text())["rows"]


def main():
    programs, turns = sys.argv[1:3], int(sys.argv[3]) if len(sys.argv) > 3 else 5
    runs = [[study(program) for program in programs] for _ in range(turns)]
    print("| cell | estimator | packaged, µs | native, µs | packaged over native |\n|---|---|---|---|---|")
    for k, row in enumerate(runs[0][0]):
        packaged, native = (statistics.median(turn[p][k]["latency_median_us"] for turn in runs) for p in (0, 1))
        print(f"| {name(row['cell'])} | {row['estimator']} | {packaged:.0f} | {native:.0f} | {packaged / native:.2f} |")


if __name__ == "__main__":
    main()
