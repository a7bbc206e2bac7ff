#!/usr/bin/env python3
"""Runs the daemon at many times its usual pace and fails when its memory, file descriptors or threads grow.

The built-in scene, an eavesdropper who comes and goes, a recording ring with evidence for each alert, and a client that asks
for everything once a second. Ends after that many frames were looked at, or that many seconds, whichever is first.
"""

import argparse
import json
import os
import pathlib
import re
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request

PATHS = ["/v1/positions", "/v1/alerts?limit=100", "/v1/status", "/v1/frame.png", "/metrics"]
# The median of the last fifth over that of the second: what a warm process may still gain. The journal's pages and
# the claims' store fill within the first fifth.
PARTS = 5
MOST_GROWTH = 1.05
# Connections, and threads of a pool that fills as it is asked for, come and go on top of that.
MOST_MORE = {"file descriptors": 4, "threads": 4}
MOST_RESIDENT_MIB = 100

CONFIG = """
[source]
scene = "scene.toml"
[estimator]
{estimator}
[record]
folder = "recordings"
limit_mb = 64.0
segment_s = 5.0
evidence_limit_mb = 64.0
[journal]
path = "journal.db"
[api]
listen = "{address}"
"""


def scene(rate_hz):
    """The built-in scene, faster; whoever comes and goes does so every twenty seconds."""
    text = (pathlib.Path(__file__).parents[2] / "config/scenes/builtin.toml").read_text()
    text = re.sub(r"(?m)^rate_hz = .*$", f"rate_hz = {rate_hz}", text)
    text = re.sub(r"(?m)^integration_time_s = .*$", f"integration_time_s = {1 / rate_hz}", text)
    return re.sub(r"present = \{[^}]*\}", "present = { from_s = 5, until_s = 12, every_s = 20 }", text)


def free_address():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return f"127.0.0.1:{taken.getsockname()[1]}"


def sample(pid):
    """Resident MiB, open file descriptors, threads."""
    status = pathlib.Path(f"/proc/{pid}/status").read_text()
    field = lambda name: int(re.search(rf"(?m)^{name}:\s+(\d+)", status)[1])
    return field("VmRSS") / 1024, len(os.listdir(f"/proc/{pid}/fd")), field("Threads")


class Daemon:
    def __init__(self, program, folder, scene, estimator):
        self.address = free_address()
        (folder / "scene.toml").write_text(scene)
        name = f'name = "{estimator}"' if estimator else ""
        (folder / "oapwatch.toml").write_text(CONFIG.format(address=self.address, estimator=name))
        self.log = folder / "log"
        command = [program, "run", "--config", folder / "oapwatch.toml"]
        self.process = subprocess.Popen(command, stderr=open(self.log, "wb"))

    def ask(self, path):
        if self.process.poll() is not None:
            sys.exit(f"the daemon ended: {self.log.read_text()[-2000:]}")
        with urllib.request.urlopen(f"http://{self.address}{path}", timeout=20) as answer:
            return answer.read()

    def status(self):
        return json.loads(self.ask("/v1/status"))

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(20)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program")
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--frames", type=int, default=1 << 62, help="stop once so many were looked at")
    parser.add_argument("--rate", type=float, default=400.0, help="frames the source offers a second")
    parser.add_argument("--estimator", help="an estimator; the default one when left out")
    parser.add_argument("--unasked", action="store_true", help="without the client: the status once a minute only")
    parser.add_argument("--samples", type=pathlib.Path, help="where to write them, for soak_picture.py")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        daemon = Daemon(asked.program, pathlib.Path(folder), scene(asked.rate), asked.estimator)
        try:
            began, samples = time.monotonic(), []
            time.sleep(2)
            status = daemon.status()
            while (now := time.monotonic() - began) < asked.seconds and status["frames"]["captured"] < asked.frames:
                if not asked.unasked:
                    for path in PATHS:
                        daemon.ask(path)
                if not asked.unasked or now // 60 > len(samples) // 60:
                    status = daemon.status()
                samples.append((now, status["frames"]["captured"], *sample(daemon.process.pid)))
                time.sleep(1)
            status = daemon.status()
            raised = re.findall(r"(?m)^oapwatch_alerts_raised_total\S* (\d+)", daemon.ask("/metrics").decode())
        finally:
            daemon.stop()
    if asked.samples:
        asked.samples.write_text(json.dumps({"estimator": status["estimator"], "samples": samples}))
    frames = status["frames"]
    print(
        f"{status['estimator']}: {now:.0f} s, {frames['captured']} frames looked at, {frames['dropped']} given way to "
        f"newer ones, {sum(map(int, raised))} alerts raised, median {status['latency']['median_us']} us a frame"
    )
    part = len(samples) // PARTS
    failed = False
    for k, name in enumerate(["resident MiB", "file descriptors", "threads"], 2):
        values = [s[k] for s in samples]
        medians = [statistics.median(values[i * part : (i + 1) * part]) for i in range(PARTS)]
        grows = medians[-1] > medians[1] * MOST_GROWTH + MOST_MORE.get(name, 0)
        failed |= grows
        told = ", ".join(f"{m:.1f}" for m in medians)
        print(f"{name}: medians by fifth {told}; most {max(values):.1f}{' GROWS' if grows else ''}")
    if max(s[2] for s in samples) > MOST_RESIDENT_MIB:
        print(f"more than {MOST_RESIDENT_MIB} MiB resident")
        failed = True
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
