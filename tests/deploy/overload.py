#!/usr/bin/env python3
"""Gives the daemon ten times the frames it can handle and fails when its results grow old. Usage: overload.py PROGRAM [SECONDS].

A crowd that takes the default estimator some milliseconds a frame to tell apart. The age of a result is the wall clock when a client
of the stream has it, less the frame's own time.
"""

import datetime
import json
import pathlib
import statistics
import sys
import tempfile
import threading
import time
import urllib.request

from soak import Daemon

OVERLOAD = 10
# What an operator would call late. Ten frames' worth of computing is far below it.
OLDEST_S = 1.0

SCENE = """
rate_hz = {rate_hz}
[optics]
spot_sigma_m = 0.0012
[link]
power_w = 5.0
integration_time_s = 0.0005
coherence_time_s = 0.0005
[effects]
thermal_noise = {{}}
"""


def crowd(rate_hz):
    users = [f'[[user]]\nname = "u-{k}"\nmotion.still = [{k % 5 * 22 - 44}, {k // 5 * 22 - 44}]\n' for k in range(25)]
    return SCENE.format(rate_hz=rate_hz) + "".join(users)


class Ages(threading.Thread):
    """Follows the stream and notes how old each result is."""

    def __init__(self, address):
        super().__init__(daemon=True)
        self.address = address
        self.ages = []

    def run(self):
        try:
            with urllib.request.urlopen(f"http://{self.address}/v1/events", timeout=20) as stream:
                kind = ""
                for line in stream:
                    if line.startswith(b"event:"):
                        kind = line[6:].strip()
                    elif line.startswith(b"data:") and kind == b"positions":
                        now = time.time()
                        made = json.loads(line[5:])["time"]
                        self.ages.append(now - datetime.datetime.fromisoformat(made.replace("Z", "+00:00")).timestamp())
        except OSError:
            return


def run(program, rate_hz, seconds):
    """Counts, ages in s, and the daemon's own latency in s."""
    with tempfile.TemporaryDirectory() as folder:
        daemon = Daemon(program, pathlib.Path(folder), crowd(rate_hz), None)
        try:
            time.sleep(3)
            ages = Ages(daemon.address)
            ages.start()
            before = daemon.status()["frames"]
            time.sleep(seconds)
            status = daemon.status()
            counts = {name: status["frames"][name] - before[name] for name in before}
            return counts, sorted(ages.ages), status["latency"]["median_us"] / 1e6
        finally:
            daemon.stop()


def tell(what, rate_hz, seconds, counts, ages):
    at = lambda share: 1000 * ages[min(int(share * len(ages)), len(ages) - 1)]
    print(
        f"{what}: {rate_hz:.0f} frames/s offered, {counts['captured'] / seconds:.0f}/s looked at, {counts['dropped'] / seconds:.0f}/s "
        f"given way to newer ones; age of {len(ages)} results: median {at(0.5):.1f} ms, 99 % {at(0.99):.1f} ms, most {at(1):.1f} ms"
    )


def main():
    program, seconds = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 60
    counts, ages, latency = run(program, 2.0, 15)
    tell("at ease", 2.0, 15, counts, ages)
    rate_hz = OVERLOAD / latency
    counts, ages, latency = run(program, rate_hz, seconds)
    tell("overloaded", rate_hz, seconds, counts, ages)
    print(f"median {1000 * latency:.1f} ms a frame; {statistics.fmean(ages) / latency:.1f} frames' worth of computing old on average")
    if ages[-1] > OLDEST_S:
        sys.exit(f"a result was {ages[-1]:.2f} s old")


main()
