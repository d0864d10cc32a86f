#!/usr/bin/env python3
"""Tests the optional cameras on this machine: GStreamer pipelines, and an RTSP server on loopback.

Usage: check_cameras.py FOLDER_OF_PROGRAMS. The RTSP part needs GStreamer's server for Python (Debian:
gir1.2-gst-rtsp-server-1.0 python3-gi) and an H.264 encoder (gstreamer1.0-plugins-ugly).
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILM = ROOT / "services/camera/testdata/ball.mp4"
SOURCE = "videotestsrc is-live=true ! video/x-raw,width=64,height=64,framerate=20/1"
PORT = 8651
SERVER = f"""
import gi
gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_service("{PORT}")
factory = GstRtspServer.RTSPMediaFactory()
factory.set_launch("( {SOURCE} ! x264enc tune=zerolatency key-int-max=10 ! rtph264pay name=pay0 pt=96 )")
factory.set_shared(True)
server.get_mount_points().add_factory("/test", factory)
server.attach(None)
print("ready", flush=True)
GLib.MainLoop().run()
"""


def graph(folder: Path, camera: str) -> Path:
    path = folder / "graph.toml"
    path.write_text(f'[run]\nname = "check-cameras"\ndataset = "none"\ncheckpoint = "none"\n'
                    f"frame_rate_hz = 20.0\n[camera]\n{camera}\n")
    return path


def check(programs: Path, file: Path, *more: str) -> tuple[int, str]:
    """Runs `carff camera check`; returns exit code and output."""
    done = subprocess.run([programs / "carff", "camera", "check", file, "--seconds", "2", *more],
                          capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout + done.stderr


def good(programs: Path, file: Path, what: str, least: int) -> None:
    image = file.with_name("check.png")
    code, text = check(programs, file, "--image", str(image))
    found = re.search(r"frames\s+(\d+) of 64x64", text)
    if code != 0 or not found or int(found[1]) < least or not image.stat().st_size:
        sys.exit(f"{what}: exit code {code}\n{text}")
    print(f"{what}: {found[1]} frames")


def bad(programs: Path, file: Path, what: str, *words: str) -> None:
    code, text = check(programs, file)
    errors = [line for line in text.splitlines() if line.startswith("error:")]
    if code != 1 or len(errors) != 1 or not all(word in errors[0] for word in words):
        sys.exit(f"{what}: exit code {code}, wanted {words}\n{text}")
    print(f"{what}: {errors[0]}")


def pipelines(programs: Path, folder: Path) -> None:
    def pipeline(text: str, more: str = "") -> Path:
        return graph(folder, f'source = "pipeline"\npipeline = "{text}"\n{more}')

    good(programs, pipeline(f"{SOURCE} ! videoconvert ! appsink"), "test source", 10)
    good(programs, pipeline(f"filesrc location={FILM} ! decodebin ! videoconvert ! appsink", "repeat = true"), "film", 10)
    bad(programs, pipeline("nosuchelement ! appsink"), "no such element", "camera.pipeline", "nosuchelement")
    bad(programs, pipeline(f"{SOURCE} ! fakesink"), "no appsink", "has no appsink")
    bad(programs, pipeline("filesrc location=/no/such.mp4 ! decodebin ! videoconvert ! appsink"), "no such file",
        "camera.pipeline", "failed")
    bad(programs, pipeline("v4l2src device=/dev/video77 ! videoconvert ! appsink"), "no such device",
        "camera.pipeline", "/dev/video77")
    bad(programs, pipeline("videotestsrc ! video/x-raw,format=GRAY8 ! appsink"), "formats that do not fit", "videoconvert")
    bad(programs, pipeline("videotestsrc num-buffers=0 ! videoconvert ! appsink"), "no images", "before its first image")


def network(programs: Path, folder: Path) -> None:
    def serve() -> subprocess.Popen:
        server = subprocess.Popen(["/usr/bin/python3", "-c", SERVER], stdout=subprocess.PIPE, text=True)
        if server.stdout.readline().strip() != "ready":
            sys.exit("the RTSP server does not start: see the usage")
        return server

    address = f"rtsp://127.0.0.1:{PORT}"
    file = graph(folder, f'source = "rtsp"\nurl = "{address}/test"')
    bad(programs, file, "no server", "no images from", "cannot connect")
    server = serve()
    good(programs, file, "RTSP", 10)
    bad(programs, graph(folder, f'source = "rtsp"\nurl = "{address}/other"'), "no such stream", "no images from")
    gst = f"rtspsrc location={address}/test latency=0 ! decodebin ! videoconvert ! appsink"
    good(programs, graph(folder, f'source = "pipeline"\npipeline = "{gst}"'), "RTSP by GStreamer", 10)

    lost_and_back(programs, folder, address, server, serve)


def lost_and_back(programs: Path, folder: Path, address: str, server: subprocess.Popen, serve) -> None:
    """The camera of a running stage is lost and comes back."""
    file = graph(folder, f'source = "rtsp"\nurl = "{address}/test"')
    command = [programs / "carff-camera-rtsp", "--graph", file, "--run", "check-cameras-2", "--run-id", "7"]
    log = folder / "camera.log"
    with log.open("w") as output:
        camera = subprocess.Popen(command, stderr=output)
    try:
        wait(log, "ready")
        server.kill()
        server.wait()
        wait(log, "connecting again")
        server = serve()
        wait(log, "delivers again")
        print("RTSP: lost and back")
        camera.terminate()
        if camera.wait(20) != 0:
            sys.exit(f"the camera ended with {camera.returncode}")
    finally:
        camera.kill()
        server.kill()


def wait(log: Path, word: str) -> None:
    begun = time.monotonic()
    while word not in log.read_text():
        if time.monotonic() - begun > 120:
            sys.exit(f"the camera did not log `{word}`:\n{log.read_text()}")
        time.sleep(0.1)


def main() -> None:
    programs = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as folder:
        pipelines(programs, Path(folder))
        network(programs, Path(folder))
    print("cameras: passed")


main()
