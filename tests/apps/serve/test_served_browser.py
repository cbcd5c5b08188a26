"""A page in a real browser that attacks a served plant moves nothing."""

import struct
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from kit.browser import browser_page, find_browser
from kit.served import SPEED, packed, served, waited_for
from servobench.harness.apps.serve.server import PORTS

pytestmark = pytest.mark.skipif(
    find_browser() is None, reason="no Chromium: no page attacks a served plant"
)
SCRIPT = "\nend\ndef rtde_control():\n  pass\nend\n"
PAGE = """<!doctype html><title>attack</title>
<script>
const host = "%(host)s", move = Uint8Array.from(%(move)s);
function post(scheme, port, body) {
  fetch(`${scheme}://${host}:${port}/`, {method: "POST", mode: "no-cors", body: new Blob(body)}).catch(() => {});
}
// POST is the head of a start packet of 20,559 bytes. It ends among questions of 3 bytes, wherever the header ends.
const questions = new Uint8Array(3 * 40).map((_, k) => [0, 3, 118][k %% 3]);
for (const header of [500, 400, 600])
  for (let shift = 0; shift < 3; shift++) post("http", 30004, ["x".repeat(20459 + shift - header), questions, move]);
post("http", 30003, [%(script)s]);
post("http", 29999, ["\\nstop\\n"]);
post("http", 30020, ["\\npictures\\n"]);
for (const port of [30004, 30003, 29999, 30020]) {
  post("https", port, ["\\nstop\\n"]);
  new WebSocket(`ws://${host}:${port}/`);
}
function ask(port) {
  const frame = document.body.appendChild(Object.assign(document.createElement("iframe"), {name: "to" + port}));
  const form = document.body.appendChild(document.createElement("form"));
  Object.assign(form, {method: "POST", enctype: "text/plain", action: `http://${host}:${port}/`, target: frame.name});
  const text = form.appendChild(document.createElement("textarea"));
  Object.assign(text, {name: "a", value: "\\nstop\\n" + %(script)s});
  form.submit();
}
addEventListener("load", () => { for (const port of [30004, 30003, 29999, 30020]) ask(port); });
</script>
<body></body>
"""


@pytest.mark.slow
def test_a_page_of_a_browser_moves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "servobench.harness.apps.serve.server.script_version", lambda _: ("a test", True)
    )
    move = packed("I", ",".join(SPEED).encode())
    move += packed("U", b"\x01" + struct.pack(">i8d", 1, *[0.5] * 6, 1.0, 1.0))
    (tmp_path / "site").mkdir()
    pages = ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path / "site")
    )
    threading.Thread(target=pages.serve_forever, daemon=True).start()
    try:
        with (
            served(lockstep=False) as (server, address, lines),
            browser_page(tmp_path / "profile") as page,
        ):
            server.program.begin()
            before = server.rollout.observation.joint_position
            text = PAGE % {"host": address, "move": list(move), "script": repr(SCRIPT)}
            (tmp_path / "site" / "index.html").write_text(text, encoding="utf-8")
            page.call("Page.navigate", url=f"http://localhost:{pages.server_port}/")

            def is_refused():
                """Return whether each port has refused a fetch in the clear, one by TLS, a WebSocket and a form."""
                counts = {
                    port: sum(line.startswith(f"{port}: ") for line in lines) for port in PORTS
                }
                return counts["RTDE"] >= 12 and min(counts.values()) >= 4

            refused = waited_for(is_refused, 60.0)
            assert np.array_equal(server.rollout.observation.joint_position, before)
            assert server.program.running
            assert not server.program.inputs
            assert not any("control program" in line for line in lines)
            assert refused, lines
    finally:
        pages.shutdown()
        pages.server_close()
