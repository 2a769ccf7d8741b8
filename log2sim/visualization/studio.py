"""The studio: a page on which a scenario is corrected, served to this computer alone."""

from __future__ import annotations

import json
import secrets
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from log2sim.datatypes import Scenario
from log2sim.edit.corrections import Corrected, correct, load_corrections
from log2sim.errors import Log2SimError, ScenarioError
from log2sim.files.documents import check, write_json
from log2sim.road.ground_map import GroundMap
from log2sim.visualization.page.document import feature_columns, page_document
from log2sim.visualization.page.writer import make_page, page_html
from log2sim.visualization.recording import Recorded

# A hundred thousand corrections have some 20 MB.
MAX_BODY_BYTES = 32_000_000
HOST = "127.0.0.1"


class Studio:
    """A scenario with the corrections of a file, which every change of the page is written to.

    `address`: of the page, with a token that each run makes anew. `result`: the scenario with all corrections so far.
    """

    def __init__(
        self,
        scenario: Scenario,
        path: Path,
        *,
        recorded: Recorded | None = None,
        background: GroundMap | None = None,
        port: int = 0,
    ) -> None:
        """Open a scenario; `path` holds its corrections, earlier ones are gone on with.

        Raises `ScenarioError` or `ConfigError` when the file is none of corrections, or they contradict each other.
        Raises `OSError` when the port is taken.
        """
        self.scenario, self.path, self.recorded, self.background = scenario, path, recorded, background
        empty = {"format": "log2sim-corrections", "version": 1, "log": scenario.name, "corrections": []}
        self.document: dict[str, Any] = load_corrections(path) if path.exists() else empty
        self.result: Corrected = correct(scenario, self.document)
        self._token = secrets.token_urlsafe(24)
        self._version = 0  # of the corrections: a page that does not know the present one would drop some
        self._lock = threading.Lock()
        # Pictures and points take long to gather: once, with the corrections of then.
        self._recording: tuple[Corrected, dict[str, Any] | None] | None = None
        self._server = ThreadingHTTPServer((HOST, port), type("Handler", (_Handler,), {"served": self}))
        self._server.daemon_threads = True
        self.origin = f"http://{HOST}:{self._server.server_address[1]}"
        self.address = f"{self.origin}/{self._token}/"

    def serve(self) -> None:
        """Answer until `close` is called or the program is interrupted."""
        try:
            self._server.serve_forever(poll_interval=0.1)
        finally:
            self._server.server_close()

    def close(self) -> None:
        """Have `serve` return."""
        self._server.shutdown()

    def page(self) -> bytes:
        """Return the page with the scenario as it is corrected now."""
        with self._lock:
            document = page_document(self.result.scenario, background=self.background)
            document["studio"] |= {
                "address": f"/{self._token}/corrections",
                "version": self._version,
                "corrections": self.document["corrections"],
                "before": [{**entry, "doubts": [], "doubted": []} for entry in _agents(self.scenario)],
                "corrected": self._recording is not None and self._recording[0] is not self.result,
            }
            if self._recording is None:
                page = make_page(document, self.result.scenario, self.recorded)
                self._recording = self.result, document["recording"]
                return page
            document["recording"] = self._recording[1]
            return page_html(document).encode()

    def keep(self, body: bytes, version: str | None = None) -> dict[str, Any]:
        """Apply a document of corrections, write it to the file, and return what the page shows of the scenario then.

        Raises `Log2SimError` for what is no such document, for corrections that cannot be, and when another page has corrected
        since `version`.
        """
        try:
            document = json.loads(body, parse_constant=_refuse)
        except (ValueError, RecursionError) as problem:
            raise ScenarioError(f"no JSON: {type(problem).__name__}") from None
        check(document, "corrections-1", ScenarioError)
        with self._lock:
            if version not in (None, str(self._version)):
                raise ScenarioError("another page of this studio has corrected meanwhile; load this one again")
            result = correct(self.scenario, document)
            write_json(self.path, document)
            self.document, self.result = document, result
            self._version += 1
            version = str(self._version)
        shown = {"agents": _agents(result.scenario), "features": feature_columns(result.scenario), "version": version}
        return {**shown, "unmatched": list(result.unmatched)}

    def allows(self, request: BaseHTTPRequestHandler, end: str) -> bool:
        """Whether a request is for what ends so of this run, asked of this computer by its own page."""
        named = request.path.startswith(f"/{self._token}/") and request.path.endswith(end)
        asked = request.headers["Host"] == self.origin.removeprefix("http://")
        return named and asked and request.headers["Origin"] in (None, self.origin)


def _agents(scenario: Scenario) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = page_document(scenario)["layers"]["scenario"]
    return entries


def _refuse(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


class _Handler(BaseHTTPRequestHandler):
    """Two answers: the page, and what corrections make of the scenario."""

    served: Studio
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "log2sim", ""
    timeout = 30

    def do_GET(self) -> None:
        """Answer with the page."""
        if not self.served.allows(self, "/"):
            return self._answer(404, "text/plain", b"not found")
        try:
            self._answer(200, "text/html; charset=utf-8", self.served.page())
        except Log2SimError as error:
            self._answer(500, "text/plain; charset=utf-8", str(error).encode())

    def do_PUT(self) -> None:
        """Keep corrections."""
        if not self.served.allows(self, "/corrections"):
            return self._answer(404, "text/plain", b"not found")
        length = self.headers["Content-Length"] or ""
        if not length.isascii() or not length.isdecimal() or int(length[:12]) > MAX_BODY_BYTES:
            self.close_connection = True
            return self._answer(413, "application/json", b'{"error": "too large"}')
        try:
            reply, code = self.served.keep(self.rfile.read(int(length)), self.headers["If-Match"]), 200
        except Log2SimError as error:
            reply, code = {"error": str(error)}, 422
        except OSError as error:
            reply, code = {"error": f"{self.served.path}: {error.strerror}"}, 500
        self._answer(code, "application/json", json.dumps(reply).encode())

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""
