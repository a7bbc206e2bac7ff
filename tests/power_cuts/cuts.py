#!/usr/bin/env python3
"""Kills a virtual machine while alerts flow, loses what its disk had not been told to keep, boots it again, and fails when an
alert of which the log or a receiver had heard is not in the journal. Usage: cuts.py VMLINUX FOLDER [--cuts N] [--seed S].

QEMU logs every write and flush of the disk. What was written before the last flush is on the disk after the cut; each later
write is, or is not, at random. Without its own flushes a kill would lose only what the guest had not written, since the
host keeps what QEMU wrote.
"""

import argparse
import json
import pathlib
import random
import shutil
import struct
import subprocess
import sys
import threading
import time

SECTOR = 512
FLUSH, DISCARD, MARK = 1, 4, 8
MAGIC = 0x6A736677736872
# Far beyond what a busy host takes.
PATIENCE_S = 900


def boot(vmlinux, folder):
    disk = {"driver": "raw", "file": {"driver": "file", "filename": str(folder / "disk")}}
    log = {"driver": "file", "filename": str(folder / "writes")}
    node = {"driver": "blklogwrites", "node-name": "disk", "file": disk, "log": log}
    command = "qemu-system-x86_64 -accel tcg -cpu qemu64 -smp 1 -m 512 -nodefaults -no-user-config -display none -no-reboot"
    command = command.split() + ["-icount", "shift=1", "-monitor", "none"]
    command += ["-serial", f"file:{folder / 'console'}", "-serial", "stdio"]
    command += ["-blockdev", json.dumps(node), "-device", "virtio-blk-pci,drive=disk,discard=off,write-zeroes=off"]
    command += ["-kernel", vmlinux, "-initrd", str(folder / "initramfs"), "-append"]
    command += ["console=ttyS0 quiet loglevel=2 panic=-1 nokaslr mitigations=off tsc=reliable no_timer_check random.trust_cpu=on"]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)


def live(machine, events):
    """Until that many events were heard since the journal was listed: what it held, and what was heard, until the kill."""
    kept, heard, listed, count, said = {}, [], False, 0, ""
    watchdog = threading.Timer(PATIENCE_S, machine.kill)
    watchdog.daemon = True
    watchdog.start()
    for line in machine.stdout:
        words = line.split()
        event = None
        if line.startswith("{"):
            entry = json.loads(line)
            if entry["message"] == "alert":
                event = entry["id"], entry["event"]
            elif entry["level"] == "ERROR":
                sys.exit(f"the daemon says {line}")
        elif words[:1] == ["heard"]:
            event = (words[1], words[2])
        elif words[:1] == ["kept"]:
            kept[words[1]] = words[2]
        elif words == ["listed"]:
            listed = True
        elif words[:1] == ["failed:"]:
            sys.exit(said or line)
        else:
            said += line
        if event is not None:
            heard.append(event)
            count += listed
            if count == events:
                machine.kill()
                break
    watchdog.cancel()
    machine.wait()
    if count < events:
        sys.exit(f"{count} events heard, {'' if listed else 'not '}listed, then nothing for {PATIENCE_S} s")
    return kept, heard


def cut(folder, rng):
    """Makes `before` what the disk holds after the cut; gives the number of writes and how many of them were lost."""
    with open(folder / "writes", "rb") as log, open(folder / "before", "r+b") as disk:
        magic, version, entries, sector = struct.unpack("<QQQI", log.read(28))
        assert (magic, version, sector) == (MAGIC, 1, SECTOR)
        at, number, writes, lost = SECTOR, 0, 0, 0
        while True:
            log.seek(at)
            head = log.read(32)
            if len(head) < 32:
                break
            first, count, flags, _ = struct.unpack("<QQQQ", head)
            # The log names its entries at each flush: those that follow are found by themselves.
            if number >= entries and not (count or flags):
                break
            assert not flags & (DISCARD | MARK)
            number += 1
            log.seek(at + SECTOR)
            at += SECTOR * (1 + count)
            if count == 0:
                continue
            writes += 1
            if number > entries and rng.random() < 0.5:
                lost += 1
                continue
            disk.seek(first * SECTOR)
            disk.write(log.read(count * SECTOR))
    return writes, lost


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("vmlinux")
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    folder = args.folder
    rng = random.Random(args.seed)
    before = folder / "before"
    before.unlink(missing_ok=True)
    subprocess.run(["mke2fs", "-q", "-F", "-t", "ext4", "-E", "lazy_itable_init=0,lazy_journal_init=0", before, "64M"], check=True, stdout=subprocess.DEVNULL)
    heard, known = set(), set()
    for number in range(args.cuts + 1):
        shutil.copyfile(before, folder / "disk")
        (folder / "writes").write_bytes(b"")
        began = time.monotonic()
        # The last boot only shows what the last cut left.
        events = rng.randint(1, 20) if number < args.cuts else 1
        with boot(args.vmlinux, folder) as machine:
            try:
                kept, new = live(machine, events)
            finally:
                machine.kill()
        lost_ids = sorted((known | {i for i, _ in heard}) - kept.keys())
        open_again = sorted(i for i, kind in heard if kind == "alert.cleared" and kept.get(i) == "open")
        if lost_ids or open_again:
            sys.exit(f"not ok: after cut {number} the journal lacks {lost_ids}; is open though heard to be over {open_again}")
        known |= kept.keys()
        heard |= set(new)
        writes, lost = cut(folder, rng)
        if number < args.cuts:
            print(f"cut {number + 1}: {len(kept)} alerts in the journal, {len(new)} events heard, {lost} of {writes} writes lost, {time.monotonic() - began:.1f} s", flush=True)
    print(f"ok: {args.cuts} cuts, {len({i for i, _ in heard})} alerts and {len(heard)} events heard, all in the journal")


main()
