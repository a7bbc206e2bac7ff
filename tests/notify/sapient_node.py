"""The other side of a SAPIENT node, for tests: accepts one node, holds every message to BSI Flex 335 v2.0 and acknowledges active alerts.

Prints its port, then a JSON line for each message: its kind and what is wrong with it, if anything.
"""

import json
import socket
import struct
import uuid

from sapient_msg.bsi_flex_335_v2_0.sapient_message_pb2 import SapientMessage as Wire
from sapient_msg_pydantic.bsi_flex_335_v2_0.sapient_message import SapientMessage

NODE = str(uuid.uuid4())


def read(stream, length):
    data = b""
    while len(data) < length:
        more = stream.recv(length - len(data))
        if not more:
            raise SystemExit(0)
        data += more
    return data


def send(stream, fill):
    message = Wire(node_id=NODE)
    message.timestamp.GetCurrentTime()
    fill(message)
    data = message.SerializeToString()
    stream.sendall(struct.pack("<I", len(data)) + data)


def say(**line):
    print(json.dumps(line), flush=True)


listener = socket.create_server(("127.0.0.1", 0))
say(port=listener.getsockname()[1])
stream, _ = listener.accept()
while True:
    (length,) = struct.unpack("<I", read(stream, 4))
    message = Wire.FromString(read(stream, length))
    kind = message.WhichOneof("content")
    fault = None
    try:
        SapientMessage.from_pb2(message).to_pb2()
    except Exception as error:
        fault = str(error)
    unknown = message.SerializeToString(deterministic=True) != Wire.FromString(message.SerializeToString()).SerializeToString(deterministic=True)
    line = {"kind": kind, "fault": fault, "unknown_fields": unknown}
    if kind == "registration":
        send(stream, lambda m: setattr(m.registration_ack, "acceptance", True))
    elif kind == "alert":
        alert = message.alert
        line["status"] = alert.status
        line["description"] = alert.description
        line["location"] = [alert.location.x, alert.location.y]
        if alert.status == 1:

            def fill(m):
                m.alert_ack.alert_id = alert.alert_id
                m.alert_ack.alert_ack_status = 1

            send(stream, fill)
    elif kind == "detection_report":
        report = message.detection_report
        line["location"] = [report.location.x, report.location.y]
        line["error"] = [report.location.x_error, report.location.y_error]
        line["id"] = report.id
        line["object_info"] = {info.type: info.value for info in report.object_info}
    elif kind == "status_report":
        line["system"] = message.status_report.system
    say(**line)
