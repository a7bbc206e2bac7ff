"""Draws the validation curves of one or more runs."""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("svg")
from matplotlib import pyplot  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    figures = {"loss": "loss", "recall_10m": "recall within 10 m", "median_squared_error_m2": "median squared error, m²"}
    for run in args.runs:
        curve = json.loads((run / "curve.json").read_text())
        for axis, (key, label) in zip(axes, figures.items()):
            axis.plot([p["samples"] for p in curve], [p[key] for p in curve], marker=".", label=run.name)
            axis.set(xlabel="samples", ylabel=label, yscale="linear" if key == "recall_10m" else "log")
            axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(args.out, metadata={"Date": None})


if __name__ == "__main__":
    main()
