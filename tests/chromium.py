"""A headless Chromium for tests of pages, spoken to over a pipe in its DevTools protocol."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "out" / "report"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium")

QUIET = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --remote-debugging-pipe"
)
WIDTHS = {"phone": 390, "desk": 1280}


class Browser:
    """One page of a headless Chromium: ``browser("Page.reload")`` sends a command of the DevTools protocol."""

    def __init__(self, profile):
        theirs, ours = os.pipe()
        back, say = os.pipe()
        # The protocol's pipe is file descriptors 3 and 4.
        shell = f'exec "{CHROMIUM}" {QUIET} --user-data-dir="{profile}" 3<&{theirs} 4>&{say}'
        self.process = subprocess.Popen(
            ["bash", "-c", shell], pass_fds=(theirs, say), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(theirs)
        os.close(say)
        self.ours, self.back, self.rest, self.count, self.session = ours, back, b"", 0, None
        self.events = []
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self.session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self("Page.enable")
        self("Network.enable")
        self("Log.enable")
        self("Runtime.enable")

    def __call__(self, method, **params):
        self.count += 1
        asked = {"id": self.count, "method": method, "params": params}
        if self.session:
            asked["sessionId"] = self.session
        os.write(self.ours, json.dumps(asked).encode() + b"\0")
        while (answer := self.next()).get("id") != self.count:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def next(self):
        while b"\0" not in self.rest:
            part = os.read(self.back, 1 << 20)
            assert part, "Chromium went away"
            self.rest += part
        message, _, self.rest = self.rest.partition(b"\0")
        return json.loads(message)

    def close(self):
        with contextlib.suppress(OSError):
            os.close(self.ours)
        self.process.terminate()
        self.process.wait(10)
        os.close(self.back)

    def show(self, path, width=1280, scheme="light", scripts=True):
        """Load a file in a window of a width; whatever it asks for is in ``events`` afterwards."""
        phone = width < 600
        self("Emulation.setDeviceMetricsOverride", width=width, height=844, deviceScaleFactor=1, mobile=phone)
        # Without motion a place that is jumped to is there at once.
        wanted = {"prefers-color-scheme": scheme, "prefers-reduced-motion": "reduce"}
        self("Emulation.setEmulatedMedia", features=[{"name": k, "value": v} for k, v in wanted.items()])
        self("Emulation.setTouchEmulationEnabled", enabled=phone)
        self("Emulation.setScriptExecutionDisabled", value=not scripts)
        self.events.clear()
        self("Page.navigate", url=path.as_uri())
        while not any(e.get("method") == "Page.loadEventFired" for e in self.events):
            self.events.append(self.next())

    def value(self, expression):
        answer = self("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def press(self, key, code=0):
        for kind in ("rawKeyDown", "keyUp"):
            self("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def picture(self, keep):
        """Screenshot of the whole page as an array, kept under a name."""
        size = self("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        data = base64.b64decode(self("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)["data"])
        KEPT.mkdir(parents=True, exist_ok=True)
        (KEPT / f"{keep}.png").write_bytes(data)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    b = Browser(tmp_path_factory.mktemp("profile"))
    yield b
    b.close()


def asked(browser):
    """What a page asked for beside itself, and what went wrong in it."""
    urls = [e["params"]["request"]["url"] for e in browser.events if e.get("method") == "Network.requestWillBeSent"]
    wrong = [
        e["params"]["entry"]["text"]
        for e in browser.events
        if e.get("method") == "Log.entryAdded" and e["params"]["entry"]["level"] == "error"
    ]
    wrong += [e["params"] for e in browser.events if e.get("method") == "Runtime.exceptionThrown"]
    return [u for u in urls if not u.startswith(("file:", "data:"))], wrong
