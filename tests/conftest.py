"""Fixtures that several test modules share."""

from __future__ import annotations

import fcntl
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import CHROMIUM, DRIVER, Browser, browsing
from hypothesis import settings

# A slow or busy machine is no failure, and half of the usual examples do.
settings.register_profile("suite", max_examples=50, deadline=None)
settings.load_profile("suite")
SHARED = Path(__file__).resolve().parents[2] / "shared"
sys.path.append(str(Path(__file__).resolve().parents[1] / "tools"))
# Many tests start processes, which would compile the package each for itself.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# One process a run and one thread for linear algebra unless a test asks for more: tests run side by side, small matrices
# are slower with threads, and tests count what happens in their process. NumPy reads it when it is first imported.
os.environ["OMP_NUM_THREADS"] = "1"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave the first case of each test marked `matrix` to the default suite, and none of recorded logs or in a browser.

    Files with slow tests come first, so that no process is left with a long one at the end.
    """
    first = set[str]()
    for item in items:
        function = f"{item.path}::{item.originalname}" if isinstance(item, pytest.Function) else item.nodeid
        needs = {"real_data", "chromium"} & set(getattr(item, "fixturenames", ()))
        if needs or (item.get_closest_marker("matrix") and function in first):
            item.add_marker(pytest.mark.slow)
        first.add(function)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let SIGINT reach the processes that a test starts.

    They inherit that it is ignored where a script started the tests in the background (`pytest &`).
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A temporary folder of all processes that run the tests of this session."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def own_cache(shared_folder: Path) -> Iterator[Path]:
    """A cache folder of the tests, for processes that they start, too; the user's is neither read nor written.

    Models are converted into it once, and the same picture is searched once.
    """
    folder = shared_folder / "cache"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOG2SIM_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def traffic_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenarios of random traffic in which vehicles cut in, overtake and brake hard."""
    from benchmarks.tag_worlds import traffic

    root = tmp_path_factory.mktemp("traffic")
    for seed in range(4):
        traffic(seed, count=8, duration_s=12.0).scenario.save(root / f"{seed}" / "scenario.json")
    return root


@pytest.fixture(scope="session")
def real_data(shared_folder: Path) -> Path:
    """The recorded logs in their native layout, laid out once; skips where they are not at hand."""
    restore = SHARED / "data" / "restore.py"
    if not restore.is_file():
        pytest.skip("recorded logs are not beside this checkout (../shared/data)")
    if importlib.util.find_spec("pandas") is None:
        pytest.skip("laying out the recorded logs needs pandas")
    out = shared_folder / "real"
    out.mkdir(exist_ok=True)
    with open(out / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (out / "complete").exists():
            subprocess.run([sys.executable, str(restore), str(out / "data")], check=True, capture_output=True)
            (out / "complete").touch()
    return out / "data"


@pytest.fixture(scope="session")
def yolox_model() -> Path:
    """A real detector; skips where it is not at hand."""
    path = SHARED / "models" / "yolox_nano.onnx"
    if not path.is_file():
        pytest.skip("the YOLOX-nano model is not beside this checkout (../shared/models)")
    return path


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of `worlds.tiny_log` as a folder with its truth; tests that change it take `log_folder`."""
    from worlds import tiny_log

    from log2sim.logs.native.writer import write_log

    folder = tmp_path_factory.mktemp("tiny") / "tiny"
    log, truth = tiny_log()
    write_log(log, folder)
    truth.save(folder / "truth.json")
    return folder


@pytest.fixture
def log_folder(tiny_folder: Path, tmp_path: Path) -> Path:
    """A copy of `tiny_folder` to be spoiled."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "log"))


@pytest.fixture(scope="session")
def tiny_scenario(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario file reconstructed from `tiny_folder`."""
    from plain_settings import ALL_KEPT

    from log2sim import Config, open_log, reconstruct

    path = tmp_path_factory.mktemp("scenario") / "scenario.json"
    config = Config.load(detect={"name": "labels"}, **ALL_KEPT)
    reconstruct(open_log(tiny_folder), config).scenario.save(path)
    return path


@pytest.fixture(scope="session")
def one_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all tests of a process; skips where there is none."""
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("needs Chromium and its driver (Debian: chromium, chromium-driver)")
    with browsing(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module")
def chromium(one_browser: Browser) -> Browser:
    """The browser, without what pages of other modules told and asked for."""
    one_browser.open("about:blank")
    one_browser.log("browser")
    one_browser.requests()
    return one_browser


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    """The browser, whose page must neither log an error nor ask for anything but itself."""
    yield chromium
    assert chromium.log("browser") == []
    asked = [address.split("#")[0] for address in chromium.requests() if not address.startswith("blob:")]
    assert {address.rpartition("/")[2] for address in asked} <= {"page.html"}
