#!/usr/bin/env python3
"""`sequence` beside a tracker that others use: Stone Soup's joint probabilistic data association (JPDA) on the detections of `ml`.

Usage: trackers.py OAPWATCH [FRAMES]. Needs numpy, scipy and stonesoup. Prints a Markdown table: the mean GOSPA distance (Rahmathullah,
Garcia-Fernandez and Svensson, 2017; order 2, cutoff 5 m) with what of its square is missed and false, and the time a frame, which for JPDA
includes that of `ml`. JPDA is told the covariance of each detection and nothing else that `sequence` is not.
"""

import json
import re
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from stonesoup.dataassociator.probability import JPDA
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.reader.base import DetectionReader
from stonesoup.tracker.simple import MultiTargetMixtureTracker
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.base import Property
from stonesoup.buffered_generator import BufferedGenerator
from stonesoup.updater.kalman import KalmanUpdater

CUTOFF_M = 5.0
AREA_M2 = 250.0**2
# Acceleration, m/s^1.5: the best for JPDA of 0.25, 0.5 and 1 in these scenes.
NOISE = 1.0
# Of `ml`: one frame in a thousand holds an emitter that is none, one in a thousand misses one that is alone.
FALSE_A_FRAME, SEEN = 1e-3, 0.999
# Frames whose tracks begin: not counted.
FIRST = 20

# Optics and light of the built-in scene, and its honest users.
LIGHT, *PEOPLE = re.split(r"(?m)^(?=\[\[)", (Path(__file__).parent.parent / "config/scenes/builtin.toml").read_text())


def walk(name, *through, speed=1.2):
    return f'[[user]]\nname = "{name}"\nmotion.walk = {{ through_m = {[list(p) for p in through]}, speed_m_s = {speed} }}\n'


def still(name, x, y):
    return f'[[user]]\nname = "{name}"\nmotion.still = [{x}, {y}]\n'


SCENES = {
    "apart: the built-in scene's six users": "".join(p for p in PEOPLE if p.startswith("[[user]]")),
    "two cross, two walk abreast": walk("a", (-40, -30), (40, 30), speed=1.0)
    + walk("b", (-40, 30), (40, -30), speed=1.0)
    + walk("c", (-40, 70), (40, 70), speed=1.0)
    + walk("d", (-40, 73), (40, 73), speed=1.0),
    "four who stand 2 m apart": still("a", 0, 0) + still("b", 2, 0) + still("c", 0, 2) + still("d", 2.2, 2.1),
}


def when(text):
    return datetime.fromisoformat(text.replace("Z", "+00:00"))


def gospa(truth, found):
    """The distance, and the squares that missed and false ones add."""
    half = CUTOFF_M**2 / 2
    if not len(truth) or not len(found):
        missed, false = half * len(truth), half * len(found)
        return (missed + false) ** 0.5, missed, false
    squares = ((np.array(truth)[:, None] - np.array(found)[None]) ** 2).sum(-1)
    rows, columns = linear_sum_assignment(np.minimum(squares, CUTOFF_M**2))
    near = [squares[r, c] for r, c in zip(rows, columns) if squares[r, c] < CUTOFF_M**2]
    missed, false = half * (len(truth) - len(near)), half * (len(found) - len(near))
    return (sum(near) + missed + false) ** 0.5, missed, false


class Detections(DetectionReader):
    """What `ml` found: frames of (time, positions, covariances)."""

    frames: list = Property()

    @BufferedGenerator.generator_method
    def detections_gen(self):
        for at, positions, covariances in self.frames:
            yield at, {
                Detection(np.array(p)[:, None], timestamp=at, measurement_model=LinearGaussian(4, (0, 2), np.array(c)))
                for p, c in zip(positions, covariances)
            }


def jpda(frames):
    """Positions of the tracks in each frame, and seconds a frame."""
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(NOISE**2)] * 2))
    model = LinearGaussian(4, (0, 2), np.eye(2))
    updater = KalmanUpdater(model)
    deleter = UpdateTimeStepsDeleter(8)
    first = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, measure=Mahalanobis(), missed_distance=4))
    initiator = MultiMeasurementInitiator(
        prior_state=GaussianState([[0], [0], [0], [0]], np.diag([100.0**2, 2.5**2, 100.0**2, 2.5**2])),
        measurement_model=None,
        deleter=UpdateTimeStepsDeleter(2),
        data_associator=first,
        updater=updater,
        min_points=3,
    )
    tracker = MultiTargetMixtureTracker(
        initiator=initiator,
        deleter=deleter,
        detector=Detections(frames),
        data_associator=JPDA(PDAHypothesiser(predictor, updater, FALSE_A_FRAME / AREA_M2, SEEN)),
        updater=updater,
    )
    answers, seconds = [], []
    began = time.perf_counter()
    for _, tracks in tracker:
        seconds.append(time.perf_counter() - began)
        answers.append([track.state_vector[[0, 2], 0].astype(float).ravel() for track in tracks])
        began = time.perf_counter()
    return answers, seconds


def located(program, folder, estimator):
    command = [program, "locate", "--config", folder / "oapwatch.toml", "--estimator", estimator, folder / "frames.npy"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [json.loads(line) for line in lines]


def main():
    program = sys.argv[1]
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
    print("| scene | tracker | GOSPA, m | missed, m² | false, m² | ms a frame: median | 99th |\n|---|---|---|---|---|---|---|")
    for name, users in SCENES.items():
        with tempfile.TemporaryDirectory() as folder:
            folder = Path(folder)
            (folder / "scene.toml").write_text(LIGHT + users)
            simulate = [program, "simulate", "--scene", folder / "scene.toml", "--frames", str(count), "--seed", "1"]
            subprocess.run([*simulate, "--out", folder / "out"], check=True, capture_output=True)
            truth = [json.loads(line) for line in (folder / "out/truth.ndjson").read_text().splitlines()]
            places = [[(e["x_m"], e["y_m"]) for e in t["emitters"] if e["in_view"]] for t in truth]
            alone, together = (located(program, folder / "out", e) for e in ("ml", "sequence"))
        of = lambda line, key: [e[key] for e in line["emitters"]]
        at = lambda line: [(e["x_m"], e["y_m"]) for e in line["emitters"]]
        frames = [(when(t["time"]), at(a), of(a, "cov_m2")) for t, a in zip(truth, alone)]
        tracks, seconds = jpda(frames)
        ms = lambda lines: [1e-3 * line["latency_us"] for line in lines]
        rows = {
            "`ml` alone": ([at(a) for a in alone], ms(alone)),
            "JPDA on `ml`": (tracks, [m + 1e3 * s for m, s in zip(ms(alone), seconds)]),
            "`sequence`": ([at(t) for t in together], ms(together)),
        }
        for tracker, (found, times) in rows.items():
            scores = np.array([gospa(t, f) for t, f in zip(places[FIRST:], found[FIRST:])])
            distance, missed, false = scores.mean(0)
            print(f"| {name} | {tracker} | {distance:.3f} | {missed:.2f} | {false:.3f} | {np.median(times):.2f} | {np.quantile(times, 0.99):.2f} |")


if __name__ == "__main__":
    main()
