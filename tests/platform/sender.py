#!/usr/bin/env python3
"""Plays an autopilot with pymavlink: sends telemetry to a UDP port, answers TIMESYNC, and prints what it sent as NDJSON.

    sender.py PORT odometry|attitude|mavlink1 COUNT [KEY]

KEY, 64 hexadecimal digits, signs what is sent and refuses what is not signed.
"""
import json
import math
import os
import sys
import time

kind = sys.argv[2]
if kind != "mavlink1":
    os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil  # noqa: E402  (the version is chosen before)

port, count = int(sys.argv[1]), int(sys.argv[3])
link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=7, source_component=1)
if len(sys.argv) > 4:
    link.setup_signing(bytes.fromhex(sys.argv[4]), sign_outgoing=True)
mav = mavutil.mavlink
# The autopilot started an hour and 27 s before this script.
began = time.time() - 3627.0
answers = 0


def boot():
    return time.time() - began


def answer():
    """Answers questions for the time, as long as there are any."""
    global answers
    while (message := link.recv_match(type="TIMESYNC", blocking=False)) is not None:
        if message.tc1 == 0:
            link.mav.timesync_send(int(boot() * 1e9), message.ts1)
            answers += 1


def attitude(k):
    """Turned about all axes, differently each time."""
    turn, length = (0.3, -0.2, 1.0), 0.02 * k
    norm = math.sqrt(sum(v * v for v in turn))
    return [math.cos(length / 2), *(math.sin(length / 2) * v / norm for v in turn)]


for k in range(count):
    if k % 10 == 0:
        link.mav.heartbeat_send(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 0, 0, mav.MAV_STATE_ACTIVE)
    q, now = attitude(k), boot()
    ned = [1.5 * k, -0.5 * k, -100.0 - 0.1 * k]
    if kind == "odometry":
        covariance = [0.0] * 21
        for at, variance in zip((0, 6, 11, 15, 18, 20), (0.25, 0.36, 0.49, 1e-5, 2e-5, 9e-5)):
            covariance[at] = variance
        link.mav.gps_global_origin_send(481370000, 115750000, 520000)
        link.mav.odometry_send(
            int(now * 1e6), mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD, *ned, q, 0, 0, 0, 0, 0, 0,
            covariance, [math.nan] * 21, 0, mav.MAV_ESTIMATOR_TYPE_AUTOPILOT, 90)
    else:
        latitude, longitude = 481370000 + 100 * k, 115750000 - 50 * k
        extensions = dict(alt_ellipsoid=568000, h_acc=1200, v_acc=1900) if kind == "attitude" else {}
        link.mav.gps_raw_int_send(int(now * 1e6), 3, latitude, longitude, 520000, 90, 120, 0, 0, 14, **extensions)
        link.mav.global_position_int_send(int(now * 1e3), latitude, longitude, 520000 + 10 * k, 0, 0, 0, 0, 0)
        link.mav.attitude_quaternion_send(int(now * 1e3), *q, 0, 0, 0)
    print(json.dumps({"k": k, "unix_s": began + now, "q": q, "ned": ned}), flush=True)
    until = time.time() + 0.02
    while time.time() < until:
        answer()
        time.sleep(0.0005)
print(json.dumps({"answers": answers}), flush=True)
