"""What is released: the version, wheel and sdist outside the checkout, the citation, typed examples, no telemetry."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

import pytest
from worlds import tiny_log

from log2sim.cli import app
from log2sim.files.plugins import BUILT_IN
from log2sim.files.version import FALLBACK

ROOT = Path(__file__).resolve().parents[1]
GIT = ("git", "-c", "user.name=test", "-c", "user.email=test@example.org", "-c", "commit.gpgsign=false")
UNTYPED = ("[no-untyped-def]", "[no-untyped-call]", "[union-attr]")
"""What short examples of the README may do: state no types, and save the figure of axes, which could be a part of one."""

INSTALLED = """
import json, sys
from importlib import resources
import log2sim
from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.files.documents import load_schema
from log2sim.perception.detect3d.detectors import create_lidar_detector
detector = create_lidar_detector("lidar:vehicle", Log("made", "log2sim", {}, {}, {}), Config().lidar)
page = resources.files("log2sim.visualization.page").joinpath("page.html").read_text(encoding="utf-8")
typed = resources.files("log2sim").joinpath("py.typed").is_file()
print(json.dumps([log2sim.__file__, log2sim.__version__, load_schema("scenario-1")["$schema"], detector.name, len(page), typed]))
"""


def call(*command: str | Path, cwd: Path, **variables: str) -> str:
    """Run a command outside the checkout and return what it prints."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH" and "SETUPTOOLS_SCM" not in name}
    ran = subprocess.run(
        [str(c) for c in command], cwd=cwd, env=kept | variables, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with the files of this one, in a folder that has the name of the package, as a clone has."""
    pytest.importorskip("hatch_vcs")
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs git to tell the files of the checkout from others")
    folder = tmp_path_factory.mktemp("release") / "log2sim"
    listed = call("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=ROOT)
    wanted = ("log2sim/", "schemas/", "samples/cookbook/", "pyproject.toml", "README.md", "LICENSE", ".gitignore")
    for name in filter(None, listed.split("\0")):
        if name.startswith(wanted) and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    call("git", "init", "-q", cwd=folder)
    call("git", "add", "--all", cwd=folder)
    call(*GIT, "commit", "-q", "-m", "all", cwd=folder)
    return folder


def test_a_checkout_without_tags_and_a_copy_without_git_have_a_version(checkout: Path, tmp_path: Path) -> None:
    ask = "from hatchling.build import prepare_metadata_for_build_wheel as ask; print(ask({!r}))"
    named = call(sys.executable, "-c", ask.format(str(tmp_path)), cwd=checkout)
    assert re.match(r"log2sim-0\.1\.dev1\+g[0-9a-f]+\.dist-info", named)
    shutil.copytree(checkout, tmp_path / "copy", ignore=shutil.ignore_patterns(".git"))
    named = call(sys.executable, "-c", ask.format(str(tmp_path)), cwd=tmp_path / "copy")
    assert named.strip() == f"log2sim-{FALLBACK}.dist-info"


@pytest.mark.slow
def test_a_wheel_of_the_sdist_works_outside_the_checkout(checkout: Path, tiny_folder: Path, tmp_path: Path) -> None:
    call("git", "tag", "v1.2.3", cwd=checkout)
    build = "from hatchling.build import build_sdist as build; build({!r})"
    call(sys.executable, "-c", build.format(str(tmp_path)), cwd=checkout)
    with tarfile.open(tmp_path / "log2sim-1.2.3.tar.gz") as packed:
        packed.extractall(tmp_path, filter="data")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
    call(*pip, "wheel", "--no-build-isolation", "--no-deps", "-w", tmp_path, tmp_path / "log2sim-1.2.3", cwd=tmp_path)
    site, away = tmp_path / "site", tmp_path / "away"
    away.mkdir()
    install = (*pip, "install", "--no-deps", "--no-index", "--target", site)
    call(*install, tmp_path / "log2sim-1.2.3-py3-none-any.whl", cwd=away)
    # Without site an editable installation of the checkout is out of the way, and what log2sim needs is still there.
    paths = os.pathsep.join([str(site), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])

    def python(*arguments: str | Path) -> str:
        return call(sys.executable, "-S", *arguments, cwd=away, PYTHONPATH=paths)

    where, version, schema, detector, page, typed = json.loads(python("-c", INSTALLED))
    assert Path(where).is_relative_to(site)
    assert (version, detector, typed) == ("1.2.3", "lidar:vehicle", True)
    assert schema.startswith("https://json-schema.org/")
    assert page > 1000
    assert python("-m", "log2sim", "--version") == "1.2.3\n"
    python("-m", "log2sim", "reconstruct", tiny_folder, "--detector", "labels", "--out", away / "s.json", "--quiet")
    assert json.loads((away / "s.json").read_text())["provenance"]["log2sim_version"] == "1.2.3"


BASE_ONLY: dict[str, str | None] = {
    "doctor": None,
    "config": None,
    "cache": None,
    "help doubts": None,
    "inspect LOG": None,
    "inspect LOG --overlay moment.png": None,
    "inspect BAG": "ros",
    "inspect FEATHER": "parquet",
    "validate LOG": None,
    "convert LOG --stop 0.3 --out part": None,
    "detect LOG --detector lidar:labels --out boxes.json": None,
    "map LOG --cell 0.5 --out map.png": None,
    "reconstruct LOG --detector labels --out s.json": None,
    "reconstruct LOG --detector labels --poses lidar --out lidar.json": "odometry",
    "reconstruct LOG --detector ssd-mobilenet-v2 --out ssd.json": "coco",
    "bench LOG --detector ssd-mobilenet-v2 --out bench": "coco",
    "bench LOG --stop 0.3 --detector labels --out bench": None,
    "batch LOG --out batch": "cluster",
    "batch LOG --out batch --scheduler tcp://127.0.0.1:1": "cluster",
    "validate s.json": None,
    "evaluate s.json --truth LOG": None,
    "evaluate boxes.json --truth LOG": None,
    "predict s.json": None,
    "edit s.json --drop-doubtful --out edited.json": None,
    "correct s.json CORRECTIONS --out corrected.json": None,
    "replay s.json --out replay.json": None,
    "resimulate s.json --log LOG --out simulated": None,
    "replay s.json --simulator carla": "carla",
    "plot s.json --out plot.svg": None,
    "plot s.json --out film.mp4 --stop 0.2": None,
    "view s.json --log LOG --out page.html": None,
    "synth --traffic vehicle --scenes 1 --out traffic": None,
    "export s.json --to openscenario --out openscenario": None,
    "tag s.json --out tagged.json --criticality criticality.csv": None,
    "find s.json standing": "find",
    "vary s.json cut_in --out varied": "find",
    "test EGO s.json cut_in --out tested": "find",
    "export s.json --to openlabel --out openlabel": None,
    "export s.json --to lanelet2 --out lanelet2": None,
    "export s.json --to carla --out carla": None,
    "export s.json --to csv --out csv": None,
    "export s.json --to scenarionet --out scenarionet": None,
    "export s.json --to commonroad --out commonroad": None,
    "export s.json --to osi --out osi": "osi",
    "export s.json --to mcap --out mcap": "mcap",
    "export s.json --to rerun --out rerun": "rerun",
    "import openscenario/scenario.xosc --out imported.json": None,
}
"""Commands, and the extra that each needs. LOG, BAG, FEATHER, CORRECTIONS and EGO stand for paths."""


@pytest.mark.slow
def test_without_extras_every_command_works_or_names_the_one_it_needs(tiny_folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from log_encoders import ros

    feather = tmp_path / "av2" / "city_SE3_egovehicle.feather"
    (feather.parent / "calibration").mkdir(parents=True)
    feather.write_bytes(b"ARROW1\0\0ARROW1")
    corrections = tmp_path / "corrections.json"
    corrections.write_text('{"format": "log2sim-corrections", "version": 1, "corrections": []}')
    paths = {
        "LOG": str(tiny_folder),
        "BAG": str(ros.encode(tiny_log()[0], tmp_path / "bag")),
        "FEATHER": str(feather.parent),
        "CORRECTIONS": str(corrections),
        "EGO": f"{ROOT}/samples/egos.py:BrakeLate",
    }
    commands = [[paths.get(word, word) for word in line.split()] for line in BASE_ONLY]
    program = Path(__file__).with_name("base_only.py")
    printed = call(
        sys.executable,
        program,
        json.dumps(commands),
        cwd=tmp_path,
        LOG2SIM_CACHE=str(tmp_path / "cache"),
        MPLBACKEND="agg",
    )
    wrong = {}
    for (line, extra), (code, err) in zip(BASE_ONLY.items(), json.loads(printed), strict=True):
        last = (err.splitlines() or [""])[-1]
        if (extra is None and code != 0) or (
            extra is not None and (code != 5 or f"needs the extra '{extra}': pip install" not in last)
        ):
            wrong[line] = (code, err[-500:])
    assert not wrong, "\n".join(f"{line}: {code} {err}" for line, (code, err) in wrong.items())
    assert {line.split()[0] for line in BASE_ONLY} == {
        (c.name or c.callback.__name__).rstrip("_") for c in app.registered_commands if c.callback is not None
    } - {"studio"}  # it serves until it is interrupted
    formats = {line.split()[3] for line in BASE_ONLY if line.startswith("export")}
    assert formats == set(BUILT_IN["export"])
    assert not list((tmp_path / "cache").glob("**/*.onnx"))


@pytest.mark.slow
def test_the_package_and_the_examples_have_the_types_that_they_use(tmp_path: Path) -> None:
    pages = [ROOT / "README.md", *sorted((ROOT / "samples/cookbook").glob("*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    files = [tmp_path / f"readme_{k}.py" for k in range(len(blocks))]
    for file, block in zip(files, blocks):
        file.write_text(block, encoding="utf-8")
    files += sorted(path.relative_to(ROOT) for path in (ROOT / "samples").glob("*.py"))
    assert len(files) > len(blocks) > 0
    command = [sys.executable, "-m", "mypy", "--cache-dir", ROOT / ".mypy_cache", "log2sim", *files]
    ran = subprocess.run([str(c) for c in command], cwd=ROOT, capture_output=True, text=True, check=False)
    errors = [line for line in ran.stdout.splitlines() if ": error:" in line]
    # By name: of what did not change since an earlier run, errors come with the folder of that run.
    assert [line for line in errors if not (line.endswith(UNTYPED) and re.search(r"/readme_\d+\.py:", line))] == []
    assert ran.returncode in (0, 1), ran.stderr[-1000:]


def test_the_networks_run_without_telemetry(tmp_path: Path) -> None:
    """ONNX Runtime collects events in a file below the home folder and one in that of temporary files unless that is switched off."""
    code = "import log2sim, onnxruntime; print(onnxruntime.__version__)"
    environment = {
        "HOME": str(tmp_path),
        "TMPDIR": str(tmp_path),
        "PATH": os.environ["PATH"],
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert ended.stdout.strip()
    assert list(tmp_path.rglob("*")) == []
