#!/usr/bin/env python3
"""Lints a package, judges its units, and measures what it brings: sizes, and the time from start to READY=1.

Usage: package.py PACKAGE.deb. Fails on any lintian error or warning, and past the limits below.
"""

import os
import pathlib
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time

LARGEST_MB = 70.0  # the installed program, as CI builds it; link-time optimisation makes what is published smaller
SLOWEST_S = 1.0  # the median start, until the first frame is through the pipeline
STARTS = 5
MOST_EXPOSED = 13  # tenths, as systemd-analyze counts


def seconds_to_ready(program, folder, config, command="run"):
    """Starts the daemon as systemd would and waits for READY=1."""
    path = folder / "oapwatch.toml"
    path.write_text(config)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        address = str(folder / "notify")
        manager.bind(address)
        manager.settimeout(30)
        began = time.monotonic()
        daemon = subprocess.Popen(
            [program, command, "--config", path, "--listen", "127.0.0.1:0"],
            env={"NOTIFY_SOCKET": address},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            while b"READY=1" not in manager.recv(4096).splitlines():
                pass
            ready = time.monotonic() - began
            status = pathlib.Path(f"/proc/{daemon.pid}/status").read_text()
            resident = next(line for line in status.splitlines() if line.startswith("VmRSS")).split()
            return ready, int(resident[1]) / 1024
        except TimeoutError:
            daemon.kill()
            sys.exit(f"never ready: {daemon.communicate()[1].decode()}")
        finally:
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(10)
            os.unlink(address)


def hub_starts(program, folder):
    """Whether the hub's config as it is shipped is taken, and the hub ready with it although there is no server yet."""
    config = (folder / "etc/oapwatch/hub.toml").read_text().replace("/var/lib/oapwatch-fleet", str(folder))
    file = folder / "hub.toml"
    file.write_text(config)
    checked = subprocess.run([program, "check", file], check=False, capture_output=True, text=True)
    print(checked.stdout.strip() or checked.stderr.strip())
    ready, resident = seconds_to_ready(program, folder, config, "fleet")
    print(f"hub: ready after {ready:.3f} s, {resident:.0f} MiB resident then")
    return checked.returncode == 0 and "hub" in checked.stdout


def unit_is_good(folder, name):
    """Whether systemd takes the unit as it is, and how exposed it leaves the service."""
    unit = folder / "usr/lib/systemd/system" / name
    print(f"{name}:")
    judge = ["systemd-analyze", "security", "--offline=true", f"--threshold={MOST_EXPOSED}", unit]
    told = subprocess.run(judge, check=False, capture_output=True, text=True)
    print(told.stdout.strip().splitlines()[-1] if told.stdout else told.stderr)
    # The program and its manual stand where the package puts them, below the folder.
    here = folder / "verify" / unit.name
    here.parent.mkdir(exist_ok=True)
    here.write_text(unit.read_text().replace("/usr/bin/oapwatch", f"{folder}/usr/bin/oapwatch"))
    verify = ["systemd-analyze", "verify", "--recursive-errors=no", here]
    verified = subprocess.run(verify, check=False, env={**os.environ, "MANPATH": f"{folder}/usr/share/man"})
    print(f"systemd-analyze verify: {'clean' if verified.returncode == 0 else 'NOT CLEAN'}")
    return told.returncode == 0 and verified.returncode == 0


def main():
    package = pathlib.Path(sys.argv[1])
    lint = ["lintian", "--fail-on", "error,warning", "--allow-root", package]
    is_clean = subprocess.run(lint, check=False).returncode == 0
    print(f"lintian: {'clean' if is_clean else 'NOT CLEAN'}")
    failed = not is_clean
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        subprocess.run(["dpkg-deb", "--extract", package, folder], check=True)
        program = folder / "usr/bin/oapwatch"
        size = program.stat().st_size / 1e6
        print(f"package {package.stat().st_size / 1e6:.1f} MB, program {size:.1f} MB (at most {LARGEST_MB:.0f})")
        failed |= size > LARGEST_MB
        for name in ["oapwatch.service", "oapwatch-fleet.service"]:
            failed |= not unit_is_good(folder, name)
        failed |= not hub_starts(program, folder)
        journal = f'[journal]\npath = "{folder}/journal.db"\n'
        for name in ["ml", "network", "hybrid"]:
            config = f'{journal}[estimator]\nname = "{name}"\n'
            starts = [seconds_to_ready(program, folder, config) for _ in range(STARTS)]
            median = statistics.median(s for s, _ in starts)
            slowest = max(s for s, _ in starts)
            resident = max(mb for _, mb in starts)
            print(
                f"estimator {name}: ready after {median:.3f} s (median of {STARTS}, slowest {slowest:.3f} s, "
                f"at most {SLOWEST_S:.0f}), {resident:.0f} MiB resident then"
            )
            failed |= median > SLOWEST_S
    sys.exit(1 if failed else 0)


main()
