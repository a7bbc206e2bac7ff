#!/usr/bin/env python3
"""Draws what soak.py sampled: resident memory over frames. Usage: soak_picture.py PICTURE.svg SAMPLES.json..."""

import json
import pathlib
import sys

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 760, 330, 60, 20, 30, 50
COLOURS = ["#1f6f8b", "#c1666b", "#7a7a3c"]
MOST_MIB = 110


def main():
    runs = [json.loads(pathlib.Path(path).read_text()) for path in sys.argv[2:]]
    most = max(run["samples"][-1][1] for run in runs)
    x = lambda frames: LEFT + (WIDTH - LEFT - RIGHT) * frames / most
    y = lambda mib: HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * mib / MOST_MIB
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="13">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
    ]
    for mib in range(0, MOST_MIB + 1, 20):
        out.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(mib):.1f}" y2="{y(mib):.1f}" stroke="#ddd"/>')
        out.append(f'<text x="{LEFT - 8}" y="{y(mib) + 4:.1f}" text-anchor="end">{mib}</text>')
    out.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(100):.1f}" y2="{y(100):.1f}" stroke="#888" stroke-dasharray="6 4"/>')
    step = 100_000 if most > 300_000 else max(most // 5, 1)
    for frames in range(0, most + 1, step):
        out.append(f'<text x="{x(frames):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{frames // 1000}</text>')
    out.append(f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 10}" text-anchor="middle">thousand frames looked at</text>')
    out.append(f'<text x="{LEFT - 40}" y="{TOP - 12}">resident memory, MiB</text>')
    for k, run in enumerate(runs):
        samples = run["samples"]
        # The highest of each pixel's worth: a peak must not fall between two points.
        peaks = {}
        for _, frames, mib, *_ in samples:
            column = int(x(frames))
            peaks[column] = max(peaks.get(column, 0), mib)
        points = " ".join(f"{column},{y(mib):.1f}" for column, mib in sorted(peaks.items()))
        colour = COLOURS[k % len(COLOURS)]
        out.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        hours = f"{samples[-1][0] / 60:.0f} min"
        out.append(f'<text x="{LEFT + 12}" y="{HEIGHT - BOTTOM - 12 - 18 * k}" fill="{colour}">{run["estimator"]}, {hours}</text>')
    out.append("</svg>")
    pathlib.Path(sys.argv[1]).write_text("\n".join(out) + "\n")


main()
