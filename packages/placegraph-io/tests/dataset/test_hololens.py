import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture

START = 132_000_000_000_000_000
RIG = np.array([[0, 1, 0, 0.1], [-1, 0, 0, 0.02], [0, 0, 1, -0.03], [0, 0, 0, 1.0]])


def rows_of(rows):
    return "\n".join(",".join(f"{v:.9f}".rstrip("0").rstrip(".") for v in row) for row in rows)


def write(path, world, save, ending=".png"):
    depth = path / "Depth Long Throw"
    depth.mkdir()
    camera, small = world.cameras[0], world.depth_cameras[0]
    v, u = np.mgrid[: small.height, : small.width] + 0.5
    rays = small.directions(np.stack([u, v], axis=-1))
    lengths = np.linalg.norm(rays, axis=-1)
    (rays / lengths[..., None]).astype("<f4").tofile(path / "Depth Long Throw_lut.bin")
    pictures, rigs = [(camera.width - camera.cx, camera.cy, camera.width, camera.height)], []
    for i in range(len(world)):
        ticks = START + round(world.stamps[i] * 1e7)
        late = ticks + 200_000
        stored = np.dstack(
            [world.rgb[i][..., ::-1], np.full(world.rgb[i].shape[:2], 255, np.uint8)]
        )
        if ending == ".png":
            save(path / "PV" / f"{ticks}.png", world.rgb[i])
        else:
            (path / "PV").mkdir(exist_ok=True)
            stored.tofile(path / "PV" / f"{ticks}.bytes")
        units = np.rint(1000 * world.metres[i] * lengths).astype(">u2")
        head = f"P5\n{small.width} {small.height}\n65535\n".encode()
        (depth / f"{late}.pgm").write_bytes(head + units.tobytes())
        (depth / f"{late}_ab.pgm").write_bytes(head + units.tobytes())
        c = world.cameras[i]
        pictures.append((ticks, c.fx, c.fy, *world.arkit(i).ravel()))
        seen = world.arkit(i) @ np.diag([1.0, -1, -1, 1])
        rigs.append((late, *(seen @ RIG).ravel()))
    (path / "2020-01-01_pv.txt").write_text(rows_of(pictures))
    (path / "Depth Long Throw_rig2world.txt").write_text(rows_of(rigs))
    (path / "Depth Long Throw_extrinsics.txt").write_text(rows_of([RIG.ravel()]))
    return path


@pytest.mark.parametrize("ending", [".png", ".bytes"])
def test_points_and_colours(ending, recorded, save, tmp_path):
    world = recorded()
    write(tmp_path, world, save, ending)
    capture = open_capture(tmp_path)
    world.check(capture, sure=False)
    np.testing.assert_allclose(np.diff(capture.stamps), np.diff(world.stamps), atol=1e-4)


def test_what_is_lost_or_missing(recorded, save, tmp_path):
    world = recorded()
    write(tmp_path, world, save)
    file = tmp_path / "Depth Long Throw_rig2world.txt"
    first, *rows = file.read_text().splitlines()
    file.write_text("\n".join([first.partition(",")[0] + ",0" * 16, *rows]))
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no pose": 1}
    world.check(capture, [1, 2, 3], sure=False)
    (tmp_path / "Depth Long Throw_lut.bin").write_bytes(b"\0" * 12)
    with pytest.raises(InputError, match=r"lut.bin has 3 numbers, but 48 x 36 rays"):
        open_capture(tmp_path)
    (listing,) = tmp_path.glob("*_pv.txt")
    head, rows = listing.read_text().split("\n", 1)
    listing.write_text(rows)
    with pytest.raises(InputError, match=r"line 1: write `ox, oy, width, height` in the first"):
        open_capture(tmp_path)
    listing.write_text(f"{head}\n{rows}")
    (tmp_path / "PV").rename(tmp_path / "pictures")
    with pytest.raises(InputError, match=r"no PV/\*.png or PV/\*.bytes; unpack"):
        open_capture(tmp_path)
