"""Webhook receiver: answers 204 and appends each body to /run/received, which a full disk leaves alone. Needs no more than Python's minimal library."""
import socket

server = socket.create_server(("127.0.0.1", 9100))
while True:
    connection, _ = server.accept()
    with connection, connection.makefile("rb") as request:
        length = 0
        while (line := request.readline().strip()):
            name, _, value = line.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        with open("/run/received", "ab") as out:
            out.write(request.read(length) + b"\n")
        connection.sendall(b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n")
