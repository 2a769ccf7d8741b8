"""The studio: a page on which a scenario is corrected, served to this computer alone."""

from __future__ import annotations

import json
import secrets
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import CATEGORIES, Log, Scenario
from log2sim.edit.corrections import Corrected, correct, load_corrections
from log2sim.errors import Log2SimError, ScenarioError
from log2sim.files.documents import check, write_json
from log2sim.geometry import NS_PER_S, fold_radius, inverse
from log2sim.visualization.page.document import SCALES, feature_columns, page_document, second_differences
from log2sim.visualization.page.writer import make_page, page_html
from log2sim.visualization.plot.drawing import Background
from log2sim.visualization.recording import Recorded, records_within

# A hundred thousand corrections have some 20 MB.
MAX_BODY_BYTES = 32_000_000
HOST = "127.0.0.1"
# sRGB of usual paints by the names of `COLOR_NAMES`.
PAINTS = {
    "black": (25, 25, 27), "white": (238, 238, 236), "gray": (105, 106, 108), "silver": (180, 182, 184), "red": (165, 25, 30),
    "blue": (30, 65, 150), "green": (30, 100, 55), "yellow": (235, 200, 40), "brown": (95, 65, 45), "orange": (230, 110, 30),
}  # fmt: skip


class Studio:
    """A scenario with the corrections of a file, which every change of the page is written to.

    Attributes
    ----------
    address : str
        Of the page, with a token that each run makes anew.
    result : Corrected
        The scenario with all corrections so far.
    """

    def __init__(
        self,
        scenario: Scenario,
        path: Path,
        *,
        recorded: Recorded | None = None,
        background: Background | None = None,
        port: int = 0,
    ) -> None:
        """Open a scenario; `path` holds its corrections, earlier ones are gone on with.

        Raises
        ------
        ScenarioError, ConfigError
            When the file is none of corrections, or they contradict each other.
        OSError
            When the port is taken.
        """
        self.scenario, self.path, self.recorded, self.background = scenario, path, recorded, background
        empty = {"format": "log2sim-corrections", "version": 1, "log": scenario.name, "corrections": []}
        self.document: dict[str, Any] = load_corrections(path) if path.exists() else empty
        self.result: Corrected = correct(scenario, self.document)
        self._token = secrets.token_urlsafe(24)
        self._lock = threading.Lock()
        # Pictures and points take long to gather: once, with the corrections of then.
        self._recording: tuple[Corrected, dict[str, Any] | None] | None = None
        studio = self

        class Handler(_Handler):
            served = studio

        self._server = ThreadingHTTPServer((HOST, port), Handler)
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
            document["layers"]["scenario"] = _agents(self.result.scenario)
            document["studio"] = {
                "address": f"/{self._token}/corrections",
                "t0_ns": self.scenario.t0_ns,
                "map_offset_m": list(self.scenario.map.offset_m),
                "log": self.scenario.name,
                "categories": list(CATEGORIES),
                "paints": PAINTS,
                "corrections": self.document["corrections"],
                "before": [{**entry, "doubts": [], "doubted": []} for entry in _agents(self.scenario)],
                "scales": SCALES,
                "cameras": [] if self.recorded is None else _calibrations(self.recorded.log, self.scenario),
                "corrected": self._recording is not None and self._recording[0] is not self.result,
            }
            if self._recording is None:
                page = make_page(document, self.result.scenario, self.recorded)
                self._recording = self.result, document["recording"]
                return page
            document |= {"scales": SCALES, "recording": self._recording[1]}
            return page_html(document).encode()

    def keep(self, body: bytes) -> dict[str, Any]:
        """Apply a document of corrections, write it to the file, and return what the page shows of the scenario then.

        Raises `Log2SimError` for what is no such document, and for corrections that cannot be.
        """
        try:
            document = json.loads(body, parse_constant=_refuse)
        except (ValueError, RecursionError) as problem:
            raise ScenarioError(f"no JSON: {type(problem).__name__}") from None
        check(document, "corrections-1", ScenarioError)
        with self._lock:
            result = correct(self.scenario, document)
            write_json(self.path, document)
            self.document, self.result = document, result
        shown = {"agents": _agents(result.scenario), "features": feature_columns(result.scenario), "scales": SCALES}
        return {**shown, "unmatched": list(result.unmatched)}

    def allows(self, path: str, host: str | None, origin: str | None) -> bool:
        """Whether a request is for this run, asked of this computer by its own page."""
        named = path.startswith(f"/{self._token}/") and host == self.origin.removeprefix("http://")
        return named and origin in (None, self.origin)


def _agents(scenario: Scenario) -> list[dict[str, Any]]:
    """Return the agents as a page has them, with their heights."""
    entries: list[dict[str, Any]] = page_document(scenario)["layers"]["scenario"]
    return [{**e, "z_m": second_differences(scenario[e["id"]].waypoints.z_m, SCALES["x_m"])} for e in entries]


def _calibrations(log: Log, scenario: Scenario) -> list[dict[str, Any]]:
    """Return the cameras of a log with their poses at the stamps of their pictures; rolling shutters are left out."""
    out = []
    for name, camera in log.cameras.items():
        t_ns = log.streams[name].t_ns if name in log.streams else np.zeros(0, dtype=np.int64)
        t_ns = t_ns[records_within(t_ns, scenario)]
        map_T_cam, known = log.map_T_sensor(name, t_ns)
        reach = fold_radius(camera)
        entry = {
            "name": name,
            "K": [float(camera.K[0, 0]), float(camera.K[1, 1]), float(camera.K[0, 2]), float(camera.K[1, 2])],
            "model": camera.distortion_model,
            "distortion": list(map(float, camera.distortion)),
            "reach": reach if np.isfinite(reach) else 1e6,
            "t_s": np.round((t_ns[known] - scenario.t0_ns) / NS_PER_S, 4).tolist(),
            "cam_T_map": [np.round(inverse(pose)[:3].ravel(), 7).tolist() for pose in map_T_cam[known]],
        }
        out += [entry] if known.any() else []
    return out


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
        if not self.served.allows(self.path, self.headers["Host"], self.headers["Origin"]) or not self.path.endswith(
            "/"
        ):
            return self._answer(404, "text/plain", b"not found")
        try:
            self._answer(200, "text/html; charset=utf-8", self.served.page())
        except Log2SimError as error:
            self._answer(500, "text/plain; charset=utf-8", str(error).encode())

    def do_PUT(self) -> None:
        """Keep corrections."""
        if not self.served.allows(self.path, self.headers["Host"], self.headers["Origin"]) or not self.path.endswith(
            "/corrections"
        ):
            return self._answer(404, "text/plain", b"not found")
        length = self.headers["Content-Length"] or ""
        if not length.isascii() or not length.isdecimal() or int(length[:12]) > MAX_BODY_BYTES:
            self.close_connection = True
            return self._answer(413, "application/json", b'{"error": "too large"}')
        try:
            reply, code = self.served.keep(self.rfile.read(int(length))), 200
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
