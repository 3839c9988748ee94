"""Headless chromium for tests, by the DevTools protocol over pipes: no packages, no ports."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import tempfile
import time

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
QUIET = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--hide-scrollbars", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--mute-audio", "--remote-debugging-pipe",
]  # fmt: skip


def found():
    """Path of a chromium, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """One tab. ``events`` are all that it has reported, as (method, params)."""

    def __init__(self, sink, source, limit=120.0):
        self.sink, self.source, self.limit = sink, source, limit
        self.session, self.number, self.events, self.rest = None, 0, [], b""

    def _next(self, deadline):
        while b"\0" not in self.rest:
            ready, _, _ = select.select([self.source], [], [], max(deadline - time.monotonic(), 0))
            if not ready:
                raise TimeoutError(f"chromium said nothing for {self.limit:.0f} s")
            part = os.read(self.source, 1 << 16)
            if not part:
                raise EOFError("chromium is gone")
            self.rest += part
        message, _, self.rest = self.rest.partition(b"\0")
        return json.loads(message)

    def call(self, method, **params):
        """Result of a command."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        message |= {"sessionId": self.session} if self.session else {}
        os.write(self.sink, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + self.limit
        while True:
            answer = self._next(deadline)
            if answer.get("id") == self.number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self.events.append((answer["method"], answer["params"]))

    def attach(self):
        """Open the tab."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def show(self, path, width=1200, height=900, features=(), mobile=False):
        """Load a file and wait until it is there; ``features`` are CSS media, name to value."""
        media = [{"name": name, "value": value} for name, value in dict(features).items()]
        self.call("Emulation.setEmulatedMedia", features=media)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.events.clear()
        self.call("Page.navigate", url=path.resolve().as_uri())
        deadline = time.monotonic() + self.limit
        while not any(method == "Page.loadEventFired" for method, _ in self.events):
            event = self._next(deadline)
            self.events.append((event["method"], event["params"]))

    def value(self, expression):
        """What a JavaScript expression, or the promise that it is, comes to."""
        options = {"awaitPromise": True, "returnByValue": True}
        answer = self.call("Runtime.evaluate", expression=expression, **options)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def screenshot(self, path):
        """Write the whole page as PNG."""
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))


@contextlib.contextmanager
def chromium():
    """A page of a browser that lives as long as the block."""
    (read_here, write_there), (read_there, write_here) = os.pipe(), os.pipe()
    # The browser wants its pipes as 3 and 4.
    line = f'exec "$0" "$@" 3<&{read_there} 4>&{write_there}'
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            ["bash", "-c", line, found(), *QUIET, f"--user-data-dir={profile}"],
            pass_fds=(read_there, write_there), stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read_there), os.close(write_there)
        page = Page(write_here, read_here)
        try:
            page.attach()
            yield page
        finally:
            process.kill()
            process.wait()
            os.close(read_here), os.close(write_here)
