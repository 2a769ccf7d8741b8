"""Fixtures that several test modules share."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first, so that no process is left with a long one at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache folder of the tests, for processes that they start, too; the user's is neither read nor written."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOG2SIM_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def real_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recorded logs in their native layout; skips where they are not at hand."""
    restore = SHARED / "data" / "restore.py"
    if not restore.is_file():
        pytest.skip("recorded logs are not beside this checkout (../shared/data)")
    if importlib.util.find_spec("pandas") is None:
        pytest.skip("laying out the recorded logs needs pandas")
    out = tmp_path_factory.mktemp("real") / "data"
    subprocess.run([sys.executable, str(restore), str(out)], check=True, capture_output=True)
    return out


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
    from log2sim import Config, open_log, reconstruct

    path = tmp_path_factory.mktemp("scenario") / "scenario.json"
    reconstruct(open_log(tiny_folder), Config.load(detect={"name": "labels"})).scenario.save(path)
    return path
