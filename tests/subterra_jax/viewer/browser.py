"""A headless Chromium, spoken to over its debugging protocol."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
)


class Page:
    """One tab.

    Attributes:
        errors: What its console complained of.
    """

    def __init__(self, socket: str):
        self._link = connect(socket, max_size=None, open_timeout=30)
        self._ids = itertools.count(1)
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the protocol, and its answer; what the page reports meanwhile is kept."""
        number = next(self._ids)
        self._link.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._link.recv(timeout=120))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        kind, told = message.get("method"), message.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(told["exceptionDetails"])[:500])
        if kind == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.errors.append(json.dumps(told["args"])[:500])
        if kind == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.errors.append(f"{told['entry']['text']} {told['entry'].get('url', '')}")

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is worth."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, expression: str, seconds: float) -> float:
        """Waits until an expression holds; the time that it took, s."""
        began = time.monotonic()
        while not self.value(expression):
            assert time.monotonic() - began < seconds, f"not within {seconds} s: {expression}"
            time.sleep(0.1)
        return time.monotonic() - began

    def click(self, label: str) -> None:
        """Presses the button or the tab with that label with the mouse."""
        place = self.value(
            f"""(() => {{
                const named = [...document.querySelectorAll('button, [role=tab], div, span')]
                    .filter(e => e.textContent.trim() === {json.dumps(label)} && e.getClientRects().length);
                if (!named.length) return null;
                named[0].scrollIntoView({{block: 'nearest'}});
                const box = named[0].getBoundingClientRect();
                return [box.x + box.width / 2, box.y + box.height / 2];
            }})()"""
        )
        assert place, f"nothing to press is called {label!r}"
        mouse = {"x": place[0], "y": place[1], "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, **mouse)

    def screenshot(self) -> bytes:
        """What it looks like, PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """Closes the tab."""
        with contextlib.suppress(Exception):
            self.call("Page.close")
        self._link.close()


@contextlib.contextmanager
def chromium(folder: Path, size: str = "1280,800") -> Iterator[str]:
    """A browser; the address of its debugging protocol."""
    assert CHROMIUM is not None
    command = [CHROMIUM, *_FLAGS, f"--window-size={size}", f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = folder / "DevToolsActivePort"
        for _ in range(300):
            if port.exists() and port.read_text().strip():
                break
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port.read_text().split()[0]}"
    finally:
        process.terminate()
        process.wait(timeout=20)


def open_page(browser: str, url: str) -> Page:
    """A new tab with a page."""
    request = urllib.request.Request(f"{browser}/json/new?about:blank", method="PUT")
    with urllib.request.urlopen(request) as answer:
        page = Page(json.load(answer)["webSocketDebuggerUrl"])
    page.call("Page.navigate", url=url)
    return page
