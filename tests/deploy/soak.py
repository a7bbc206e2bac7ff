#!/usr/bin/env python3
"""Runs the daemon at many times its usual pace and fails when its memory, file descriptors or threads grow.

Usage: soak.py PROGRAM [SECONDS]. The built-in scene at 400 frames a second (40 times its own pace), an eavesdropper who
comes and goes, a recording ring, and a client that asks for everything once a second.
"""

import json
import os
import pathlib
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request

RATE_HZ = 400
ADDRESS = "127.0.0.1:18787"
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


def scene():
    """The built-in scene, faster; whoever comes and goes does so every twenty seconds."""
    text = (pathlib.Path(__file__).parents[2] / "config/scenes/builtin.toml").read_text()
    text = re.sub(r"(?m)^rate_hz = .*$", f"rate_hz = {RATE_HZ}.0", text)
    text = re.sub(r"(?m)^integration_time_s = .*$", f"integration_time_s = {1 / RATE_HZ}", text)
    return re.sub(r"present = \{[^}]*\}", "present = { from_s = 5, until_s = 12, every_s = 20 }", text)


def sample(pid):
    """Resident MiB, open file descriptors, threads."""
    status = pathlib.Path(f"/proc/{pid}/status").read_text()
    field = lambda name: int(re.search(rf"(?m)^{name}:\s+(\d+)", status)[1])
    return field("VmRSS") / 1024, len(os.listdir(f"/proc/{pid}/fd")), field("Threads")


def ask(path):
    with urllib.request.urlopen(f"http://{ADDRESS}{path}", timeout=10) as answer:
        return answer.read()


def main():
    program, seconds = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 600
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        (folder / "scene.toml").write_text(scene())
        (folder / "oapwatch.toml").write_text(CONFIG.format(address=ADDRESS))
        log = open(folder / "log", "wb")
        daemon = subprocess.Popen([program, "run", "--config", folder / "oapwatch.toml"], stderr=log)
        try:
            began, samples = time.monotonic(), []
            while (now := time.monotonic() - began) < seconds:
                time.sleep(1)
                if daemon.poll() is not None:
                    sys.exit(f"the daemon ended: {(folder / 'log').read_text()[-2000:]}")
                if now > 2:
                    for path in PATHS:
                        ask(path)
                samples.append(sample(daemon.pid))
            status = json.loads(ask("/v1/status"))
            raised = re.findall(r"(?m)^oapwatch_alerts_raised_total\S* (\d+)", ask("/metrics").decode())
        finally:
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(10)
    frames = status["frames"]
    print(
        f"{seconds} s, {frames['captured']} frames looked at, {frames['dropped']} given way to newer ones, "
        f"{sum(map(int, raised))} alerts raised, median {status['latency']['median_us']} us a frame"
    )
    part = len(samples) // PARTS
    failed = False
    for k, name in enumerate(["resident MiB", "file descriptors", "threads"]):
        values = [s[k] for s in samples]
        medians = [statistics.median(values[i * part : (i + 1) * part]) for i in range(PARTS)]
        grows = medians[-1] > medians[1] * MOST_GROWTH + MOST_MORE.get(name, 0)
        failed |= grows
        told = ", ".join(f"{m:.1f}" for m in medians)
        print(f"{name}: medians by fifth {told}; most {max(values):.1f}{' GROWS' if grows else ''}")
    if max(s[0] for s in samples) > MOST_RESIDENT_MIB:
        print(f"more than {MOST_RESIDENT_MIB} MiB resident")
        failed = True
    sys.exit(1 if failed else 0)


main()
