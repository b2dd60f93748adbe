"""The test command of cosmic-ray: `python -S fork_client.py SOCKET PYTEST_ARGUMENTS`."""

import json
import socket
import sys

with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as _client:
    _client.connect(sys.argv[1])
    _client.sendall(json.dumps(sys.argv[2:]).encode())
    _answer = _client.recv(1)
sys.exit(_answer[0] if _answer else 1)
