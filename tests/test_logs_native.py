"""The native log folder: what is written reads back, and what is wrong is named by file and field."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import EgoVehicle, ImageLabels, Labels, Lidar, Log, MapFrame, Stream, Sweep
from log2sim.errors import LogError, RecordError
from log2sim.files.images import decode_image
from log2sim.geometry import Camera, PoseTrack, rotation_from_rpy, transform
from log2sim.logs.native.writer import write_log
from log2sim.logs.opening import open_log, validate_log
from log2sim.logs.stamps import transverse_mercator

T0_NS = 1_700_000_000_123_456_789
FRAMES = 5


def make_log(shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0), map_frame: MapFrame | None = None) -> Log:
    """A small log in memory with a sensor of each kind on each mount, placed anywhere."""
    rng = np.random.default_rng(5)
    shift = np.array(shift_m)
    t = T0_NS + np.arange(FRAMES) * 100_000_000
    rotation = rotation_from_rpy(0.02, -0.01, np.linspace(3.0, 3.4, FRAMES))
    position = shift + np.stack([np.arange(FRAMES) * 1.5, np.full(FRAMES, 2.0), np.full(FRAMES, 0.25)], axis=1)
    poses = transform(rotation, position)
    smooth = np.linspace(0, 200, 60 * 40).reshape(40, 60)[..., None] * np.array([1.0, 0.5, 0.2])
    images = [np.clip(smooth + 5 * k, 0, 255).astype(np.uint8) for k in range(FRAMES)]
    clouds = [rng.uniform(-40, 40, (50, 3)) for _ in range(FRAMES)]
    offsets = np.arange(50) * 1_000_000 - 25_000_000
    K = np.array([[55.0, 0, 30.5], [0, 56.0, 20.5], [0, 0, 1]])
    on_ego = transform(rotation_from_rpy(-1.5, 0.1, -1.6), [1.5, 0.2, 1.4])
    in_map = transform(rotation_from_rpy(0.1, 0.2, 0.3), shift + np.array([10.0, 5.0, 6.0]))
    return Log(
        name="small",
        format="memory",
        cameras={
            "front": Camera("front", 60, 40, K, "ego", on_ego, "brown", (0.1, -0.05, 0.001, 0.002)),
            "pole": Camera("pole", 60, 40, K, "map", in_map),
        },
        lidars={"top": Lidar("top", "ego", on_ego), "world": Lidar("world", "map", in_map)},
        streams={
            "front": Stream("front", t, lambda i: images[i]),
            "pole": Stream("pole", t + 7, lambda i: images[i]),
            "top": Stream("top", t, lambda i: Sweep(int(t[i]), clouds[i], "lidar", t[i] + offsets)),
            "world": Stream("world", t, lambda i: Sweep(int(t[i]), clouds[i] + shift, "map")),
        },
        ego=PoseTrack(t, poses),
        ego_vehicle=EgoVehicle((4.0, 1.7, 1.5), 1.2),
        map=map_frame or MapFrame(),
        labels=Labels(
            t,
            np.array(["a"] * FRAMES),
            np.array(["car"] * FRAMES),
            position + np.array([10.0, 0.0, 0.5]),
            np.tile([4.4, 1.8, 1.5], (FRAMES, 1)),
            np.linspace(-1, 1, FRAMES),
            np.arange(FRAMES) % 2 == 0,
            never_labeled=("bicycle", "other"),
        ),
        image_labels={
            "front": ImageLabels(t[:2], np.array([[1.0, 2, 30, 20], [2, 3, 31, 22]]), np.array(["car", "bus"]))
        },
        ground_z_ego_m=-0.3,
        reference_camera="front",
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_log(make_log(), tmp_path / "log")
    return tmp_path / "log"


def edit(folder: Path, change: Callable[[dict], object]) -> None:
    manifest = json.loads((folder / "log.json").read_text())
    change(manifest)
    (folder / "log.json").write_text(json.dumps(manifest))


def edit_line(file: Path, line: int, text: str) -> None:
    lines = file.read_text().splitlines()
    lines[line - 1] = text
    file.write_text("\n".join(lines) + "\n")


def test_what_is_written_reads_back(folder: Path) -> None:
    """What the random logs of test_logs_properties.py do not have."""
    log, back = make_log(), open_log(folder)
    assert (back.name, back.format, back.reference_camera, back.ground_z_ego_m) == ("small", "log2sim", "front", -0.3)
    assert back.ego_vehicle == log.ego_vehicle
    assert back.notes == ()
    np.testing.assert_array_equal(back.ego.t_ns, log.ego.t_ns)
    np.testing.assert_allclose(back.ego.map_T_ego, log.ego.map_T_ego, atol=1e-12)
    for name, camera in log.cameras.items():
        assert back.cameras[name].distortion == camera.distortion
        np.testing.assert_array_equal(back.cameras[name].K, camera.K)
    np.testing.assert_array_equal(back.labels.visible, log.labels.visible)
    np.testing.assert_array_equal(back.image_labels["front"].box_px, log.image_labels["front"].box_px)
    assert validate_log(folder) == []


@pytest.mark.parametrize("sweep", ["npy", "bin"])
def test_other_sweep_files_hold_the_same_points(tmp_path: Path, sweep: str) -> None:
    write_log(make_log(), tmp_path / "log", sweep=sweep)
    read = open_log(tmp_path / "log").streams["top"].read(1)
    np.testing.assert_allclose(read.xyz_m, make_log().streams["top"].read(1).xyz_m, atol=6e-4)


def test_gnss_gives_the_poses_back(tmp_path: Path) -> None:
    log = make_log((300.0, -200.0, 0.0), MapFrame(48.1, 11.5, 500.0, transverse_mercator(48.1, 11.5)))
    write_log(log, tmp_path / "log", ego="gnss")
    back = open_log(tmp_path / "log")
    np.testing.assert_allclose(back.ego.map_T_ego[:, :3, 3], log.ego.map_T_ego[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(back.ego.map_T_ego[:, :3, :3], log.ego.map_T_ego[:, :3, :3], atol=1e-8)


def test_a_far_map_origin_changes_nothing_but_the_offset(tmp_path: Path) -> None:
    near, far = make_log(), make_log((7_000_000.0, -10_000_000.0, 0.0))
    write_log(near, tmp_path / "near")
    write_log(far, tmp_path / "far")
    a, b = open_log(tmp_path / "near"), open_log(tmp_path / "far")
    assert a.map.offset_m == (0.0, 0.0, 0.0)
    assert b.map.offset_m == (7_000_000.0, -10_000_000.0, 0.0)
    np.testing.assert_allclose(b.ego.map_T_ego, a.ego.map_T_ego, atol=1e-6)
    np.testing.assert_allclose(b.labels.center_m, a.labels.center_m, atol=1e-6)
    np.testing.assert_allclose(b.cameras["pole"].mount_T_cam, a.cameras["pole"].mount_T_cam, atol=1e-6)
    np.testing.assert_allclose(b.lidars["world"].mount_T_lidar, a.lidars["world"].mount_T_lidar, atol=1e-6)
    np.testing.assert_allclose(b.cameras["front"].mount_T_cam, a.cameras["front"].mount_T_cam, atol=1e-9)
    np.testing.assert_allclose(b.streams["world"].read(0).xyz_m, a.streams["world"].read(0).xyz_m, atol=1e-3)
    np.testing.assert_allclose(b.streams["top"].read(0).xyz_m, a.streams["top"].read(0).xyz_m, atol=1e-6)
    write_log(b, tmp_path / "again")
    assert open_log(tmp_path / "again").map.offset_m == b.map.offset_m


PCD = "FIELDS x y z intensity {t}\nSIZE 4 4 4 4 {size}\nTYPE F F F F {kind}\nPOINTS {n}\nDATA {data}\n"


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_pcd_points_and_their_times(folder: Path, data: str) -> None:
    xyz = np.array([[1.5, -2, 3], [4, 5, 6.25]])
    header = PCD.format(t="t", size=4, kind="U", n=2, data=data).encode()
    if data == "ascii":
        body = b"1.5 -2 3 0.5 100\n4 5 6.25 0.1 200\n"
    else:
        layout = np.dtype([("xyzi", "<f4", 4), ("t", "<u4")])
        rows = np.array([((1.5, -2, 3, 0.5), 100), ((4, 5, 6.25, 0.1), 200)], dtype=layout)
        body = rows.tobytes()
    (folder / "top" / "cloud.pcd").write_bytes(header + body)
    edit_line(folder / "top" / "index.csv", 2, f"{T0_NS},top/cloud.pcd")
    sweep = open_log(folder).streams["top"].read(0)
    np.testing.assert_array_equal(sweep.xyz_m, xyz)
    np.testing.assert_array_equal(sweep.t_ns - T0_NS, [100, 200])


# --- bad input: (what breaks it, words that the message must hold)


def first_sensor(m: dict) -> dict:
    return m["sensors"][0]


MANIFEST_FAULTS = {
    "version": (lambda m: m.update(log_version=2), ["log.json", "log_version"]),
    "unknown key": (lambda m: m.update(sensor=[]), ["log.json", "sensor"]),
    "rotation": (lambda m: first_sensor(m).update(rotation_wxyz=[1, 0.2, 0, 0]), ["sensors[0] 'front'", "rotation_wxyz", "norm"]),
    "focal length": (lambda m: first_sensor(m)["intrinsics"].update(fx_px=0), ["sensors[0].intrinsics.fx_px"]),
    "distortion": (lambda m: first_sensor(m)["intrinsics"].update(distortion=[1.0]), ["sensors[0]", "distortion has 1 values"]),
    "path": (lambda m: first_sensor(m).update(index="../elsewhere.csv"), ["sensors[0].index", "leaves the log folder"]),
    "name twice": (lambda m: m["sensors"][1].update(name="front"), ["sensors[1] 'front'", "occurs twice"]),
    "no ego": (lambda m: m.pop("ego"), ["sensors[0] 'front'", "mounted on the ego"]),
    "two egos": (lambda m: m["ego"].update(gnss="ego/gnss.csv"), ["log.json", "ego"]),
    "reference": (lambda m: m.update(reference_camera="rear"), ["reference_camera", "no camera 'rear'", "front, pole"]),
    "camera without K": (lambda m: first_sensor(m).pop("intrinsics"), ["sensors[0]", "intrinsics"]),
    "missing index": (lambda m: first_sensor(m).update(index="front/none.csv"), ["front/none.csv", "no such file"]),
}  # fmt: skip


@pytest.mark.parametrize("fault", MANIFEST_FAULTS)
def test_a_fault_of_the_manifest_names_its_field(folder: Path, fault: str) -> None:
    change, words = MANIFEST_FAULTS[fault]
    edit(folder, change)
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


TABLE_FAULTS = {
    "not a number": ("ego/poses.csv", 3, f"{T0_NS},x,0,0,1,0,0,0", ["poses.csv, line 3", "'x_m'", "finite number"]),
    "quaternion": ("ego/poses.csv", 3, f"{T0_NS + 5},1,1,0,0.5,0,0,0", ["poses.csv, line 3", "qw,qx,qy,qz", "0.5"]),
    "stamp": ("front/index.csv", 2, "1.5e9,front/000000.jpg", ["index.csv, line 2", "'t_ns'", "whole number"]),
    "few fields": ("front/index.csv", 2, f"{T0_NS}", ["index.csv, line 2", "1 fields"]),
    "header": ("front/index.csv", 1, "t_ns,files", ["index.csv, line 1", "'file'", "missing"]),
    "column": ("ego/poses.csv", 1, "t_ns,x_m,y_m,z_m,qw,qx,qy,qq", ["poses.csv, line 1", "'qz'"]),
    "category": ("labels/boxes_3d.csv", 2, f"{T0_NS},a,spaceship,1,2,3,4,2,1,0,1", ["line 2", "spaceship", "pedestrian"]),
    "size": ("labels/boxes_3d.csv", 2, f"{T0_NS},a,car,1,2,3,4,-2,1,0,1", ["line 2", "'width_m'", "-2"]),
    "visible": ("labels/boxes_3d.csv", 2, f"{T0_NS},a,car,1,2,3,4,2,1,0,maybe", ["line 2", "'visible'", "maybe"]),
    "camera": ("labels/boxes_2d.csv", 2, f"{T0_NS},rear,1,2,3,4,car", ["line 2", "'camera'", "rear"]),
    "empty box": ("labels/boxes_2d.csv", 2, f"{T0_NS},front,5,2,3,4,car", ["line 2", "the box is empty"]),
}  # fmt: skip


@pytest.mark.parametrize("fault", TABLE_FAULTS)
def test_a_fault_of_a_table_names_its_line_and_field(folder: Path, fault: str) -> None:
    file, line, text, words = TABLE_FAULTS[fault]
    edit_line(folder / file, line, text)
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (b"x" * 300 + b".jpg", "longer than"),
        (b"x" * 300 + b"/a.jpg", "longer than"),
        (b"ab/" * 3000 + b"a.jpg", "longer than"),
        (b"front/\xff\xfe.jpg", "not text in UTF-8: byte 0xff"),
    ],
)
def test_a_file_name_that_cannot_be_is_named_by_table_and_line(folder: Path, name: bytes, words: str) -> None:
    table = folder / "front/index.csv"
    lines = table.read_bytes().split(b"\n")
    lines[3] = lines[3].split(b",")[0] + b"," + name
    table.write_bytes(b"\n".join(lines))
    with pytest.raises(LogError, match=f"front/index.csv, line 4.*{words}"):
        open_log(folder)


def png_header(width_px: int, height_px: int) -> bytes:
    """The first chunk of a gray PNG file, sound by its check sum."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


def png(width: int, height: int) -> bytes:
    import cv2

    return cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8))[
        1
    ].tobytes()


RECORD_FAULTS = {
    "truncated JPEG": ("front", lambda f: f.write_bytes(f.read_bytes()[:-200]), "JPEG"),
    "no image": ("front", lambda f: f.write_bytes(b"hello"), "neither a JPEG nor a PNG"),
    "wrong size": ("front", lambda f: f.write_bytes(png(61, 40)), "61x40 px, the calibration is for 60x40"),
    "truncated PNG": ("front", lambda f: f.write_bytes(png(60, 40)[:-1000]), "truncated"),
    "damaged PNG": ("front", lambda f: f.write_bytes(png(60, 40)[:-600] + b"?" + png(60, 40)[-599:]), "check sum"),
    "huge PNG": ("front", lambda f: f.write_bytes(png_header(65536, 65536)), "65536x65536 px, expected 1 to"),
    "truncated npz": ("top", lambda f: f.write_bytes(f.read_bytes()[:100]), "not a readable sweep"),
    "no points": ("top", lambda f: np.savez(f, other=np.zeros(3)), "no array 'xyz_m'"),
    "pickled array": ("top", lambda f: np.savez(f, xyz_m=np.array([[None] * 3], dtype=object)), "object"),
    "flat array": ("top", lambda f: np.savez(f, xyz_m=np.zeros(7)), "(N, 3)"),
    "times": ("top", lambda f: np.savez(f, xyz_m=np.zeros((4, 3)), t_offset_ns=np.zeros(3, int)), "t_offset_ns"),
}  # fmt: skip


@pytest.mark.parametrize("fault", RECORD_FAULTS)
def test_a_record_that_cannot_be_read_is_one_record(folder: Path, fault: str) -> None:
    name, change, words = RECORD_FAULTS[fault]
    file = next(p for p in (folder / name).iterdir() if p.stem == "000002")
    change(file)
    stream = open_log(folder).streams[name]
    with pytest.raises(RecordError) as caught:
        stream.read(2)
    assert words in str(caught.value)
    assert file.name in str(caught.value)
    assert str(T0_NS + 200_000_000) in str(caught.value)
    stream.read(1)
    assert len([p for p in validate_log(folder) if file.name in p]) == 1


@pytest.mark.parametrize("beside", [b"iCCPx\0\0garbage", b"gAMA\0\0", b"sRGB\x09"])
def test_what_a_png_says_beside_its_picture_prints_nothing(beside: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    plain = png(30, 20)
    chunk = struct.pack(">I", len(beside) - 4) + beside + struct.pack(">I", zlib.crc32(beside))
    image = decode_image(plain[:33] + chunk + plain[33:], "a.png", (30, 20))
    assert np.array_equal(image, decode_image(plain, "a.png", (30, 20)))
    assert capfd.readouterr().err == ""
