"""A large upload that is interrupted: what is sent again, and the memory of the service.

    python benchmarks/interrupted_upload.py [--bytes 2000000000] [--interruptions 5]

Starts `graings serve` on a temporary folder and sends an archive of noise, in a zip without compression, by the
Python client over a connection that breaks after every so many bytes, without notice to the client. The bytes that
went over the broken and the whole connections are counted on the way. Then a job is made of the upload, which the
service refuses because it is no capture: by then it has hashed and unpacked it. Memory is the greatest resident size of
the API process.
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from contextlib import suppress
from pathlib import Path

from client import Client, RefusedError, calls

START_S = 120.0
CHUNK = 1 << 20


class Line:
    """A connection to `port` that breaks each time `each` more bytes have passed, so many `times`."""

    def __init__(self, port: int, each: int, times: int) -> None:
        self.target, self.each, self.times = port, each, times
        self.sent = self.broken = 0
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            threading.Thread(target=self._serve, args=(self.listener.accept()[0],), daemon=True).start()

    def _serve(self, near: socket.socket) -> None:
        with near, socket.create_connection(("127.0.0.1", self.target)) as far:
            back = threading.Thread(target=self._answer, args=(far, near), daemon=True)
            back.start()
            with suppress(OSError):  # broken
                while data := near.recv(CHUNK):
                    self.sent += len(data)
                    if self.broken < self.times and self.sent > (self.broken + 1) * self.each:
                        self.broken += 1
                        break
                    far.sendall(data)
            for end in (far, near):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
            back.join()

    def _answer(self, far: socket.socket, near: socket.socket) -> None:
        with suppress(OSError):
            while data := far.recv(CHUNK):
                near.sendall(data)


def peak_mb(process: int) -> int:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) // 1_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", type=int, default=2_000_000_000)
    parser.add_argument("--interruptions", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="graings-upload-") as name:
        folder = Path(name)
        archive = folder / "large.zip"
        with zipfile.ZipFile(archive, "w") as packed, packed.open("noise.bin", "w", force_zip64=True) as entry:
            noise = os.urandom(CHUNK)
            for _ in range(options.bytes // CHUNK):
                entry.write(noise)
        size = archive.stat().st_size
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "graings", "serve", "--port", str(port), "--data", str(folder / "data")]
        server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            limit = time.monotonic() + START_S
            while time.monotonic() < limit:
                with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                    break
                time.sleep(0.2)
            idle = peak_mb(server.pid)
            line = Line(port, size // (options.interruptions + 1), options.interruptions)
            began = time.monotonic()
            with Client(f"http://127.0.0.1:{line.port}", timeout=None) as client:
                upload = client.upload(archive)
                print("| | |\n|---|---:|")
                print(f"| archive, bytes | {size:,} |\n| interruptions | {line.broken} |")
                print(f"| sent, bytes | {line.sent:,} |\n| sent again | {line.sent / size - 1:.2%} |")
                print(f"| seconds, pauses included | {time.monotonic() - began:.0f} |")
                print(f"| memory of the API before, MB | {idle} |")
                print(f"| after the upload | {peak_mb(server.pid)} |", flush=True)
                try:
                    client._do(calls.submit(upload, "noise", "draft", None, 10, None, "once"))
                except RefusedError as error:
                    answer = str(error)
            print(f"| after it was unpacked | {peak_mb(server.pid)} |\n\n{answer}")
        finally:
            server.terminate()
            server.wait()


if __name__ == "__main__":
    main()
