"""A real Chromium without a window, driven over its DevTools protocol, and a server that stands in for a Jupyter kernel."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
#: anywidget's model, as far as a page uses it: it sends messages to the server and hears the answers.
PAGE = """<!doctype html><meta charset="utf-8"><title>annotator</title>
<body style="margin: 12px; background: #fff"><div id="at"></div>
<script type="module">
import widget from "/annotator.js";
const heard = [];
const model = {
  on: (event, f) => event === "msg:custom" && heard.push(f),
  off: () => {},
  send: async (content) => {
    const reply = await fetch("/message", { method: "POST", body: JSON.stringify(content) });
    if (!reply.ok) return;
    const { answer, images } = await reply.json();
    const buffers = images.map((text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer));
    heard.forEach((f) => f(answer, buffers));
  },
};
widget.render({ model, el: document.getElementById("at") });
</script>"""


class Kernel:
    """Serves the annotator's page; its messages go to `annotator.handle` unless the kernel is `dead`."""

    def __init__(self, annotator, script: Path) -> None:
        self.annotator, self.dead, lock = annotator, False, threading.Lock()
        kernel = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                known = {"/": (PAGE.encode(), "text/html"), "/annotator.js": (script.read_bytes(), "text/javascript")}
                self.answer(*known.get(self.path, (b"", "text/plain")))

            def do_POST(self) -> None:
                message = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                if kernel.dead:
                    return self.send_error(503)
                with lock:
                    answer, images = kernel.annotator.handle(message)
                content = {"answer": answer, "images": [base64.b64encode(image).decode() for image in images]}
                self.answer(json.dumps(content, allow_nan=False).encode(), "application/json")

            def answer(self, body: bytes, kind: str) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_address[1]}/"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


class Chromium:
    """One browser; a page is opened by `goto`."""

    def __init__(self, folder: Path) -> None:
        websocket = pytest.importorskip("websocket", reason="websocket-client drives the browser")
        if PROGRAM is None:
            pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", "--no-first-run",
                   "--disable-dev-shm-usage", f"--user-data-dir={folder}", "--remote-allow-origins=*"]  # fmt: skip
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen([PROGRAM, *options, "about:blank"], **quiet)
        port = folder / "DevToolsActivePort"
        wait(lambda: port.exists() and "\n" in port.read_text(), "Chromium starts", 120)
        self.base = f"http://127.0.0.1:{port.read_text().splitlines()[0]}"
        self.websocket, self.count, self.socket, self.events = websocket, 0, None, []

    def goto(self, address: str, *, width: int = 1400, height: int = 760, scale: float = 1.0) -> None:
        """Open an address in a fresh tab of this size in CSS pixels, and this device scale factor."""
        self.close_tab()
        with urlopen(Request(f"{self.base}/json/new?about:blank", method="PUT")) as reply:
            tab = json.load(reply)
        self.tab, self.scale = tab["id"], scale
        self.socket = self.websocket.create_connection(tab["webSocketDebuggerUrl"], timeout=120)
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.events.clear()
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=address)

    def close_tab(self) -> None:
        if self.socket is not None:
            urlopen(f"{self.base}/json/close/{self.tab}").close()
            self.socket.close()
            self.socket = None

    def call(self, method: str, **parameters: object) -> dict:
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        while True:
            reply = json.loads(self.socket.recv())
            if reply.get("id") == self.count:
                assert "error" not in reply, reply
                return reply["result"]
            self.events.append(reply)

    def told(self, method: str) -> list[dict]:
        """The parameters of the events of this name since the page was opened."""
        return [event["params"] for event in self.events if event.get("method") == method]

    def value(self, expression: str) -> object:
        reply = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in reply, reply
        return reply["result"].get("value")

    def until(self, expression: str, what: str) -> None:
        wait(lambda: self.value(expression), what)

    def settle(self) -> None:
        """Wait until the page has drawn what it knows."""
        self.value("new Promise((f) => requestAnimationFrame(() => requestAnimationFrame(() => f(true))))")

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def wheel(self, x: float, y: float, delta: float) -> None:
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=delta)

    def press(self, *keys: str, shift: bool = False) -> None:
        for key in keys:
            text = {"text": key} if len(key) == 1 else {"text": "\r"} if key == "Enter" else {}
            self.call("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=8 * shift, **text)
            self.call("Input.dispatchKeyEvent", type="keyUp", key=key, modifiers=8 * shift)

    def picture(self) -> np.ndarray:
        """The page as (h, w, 3) uint8 RGB, in device pixels."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)

    def quit(self) -> None:
        self.close_tab()
        self.process.terminate()
        self.process.wait(20)


def wait(ready, what: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end, f"waited {seconds:.0f} s in vain: {what}"
        time.sleep(0.05)
