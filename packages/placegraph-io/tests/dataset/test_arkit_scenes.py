import numpy as np
import pytest

from placegraph.core.geometry import vector_from_rotation
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture

VIDEO = "41048190"


def write(path, world, save):
    rows = []
    for i in range(len(world)):
        name = f"{VIDEO}_{world.stamps[i] + 3000:.3f}"
        save(path / "lowres_wide" / f"{name}.png", world.rgb[i])
        save(path / "lowres_depth" / f"{name}.png", world.units(i))
        save(path / "confidence" / f"{name}.png", world.sure[i])
        c = world.cameras[i]
        folder = path / "lowres_wide_intrinsics"
        folder.mkdir(exist_ok=True)
        # a millisecond off, as some are
        late = f"{VIDEO}_{world.stamps[i] + 3000.001 * (i % 2 == 0) + 3000 * (i % 2):.3f}"
        (folder / f"{late}.pincam").write_text(f"96 72 {c.fx} {c.fy} {c.cx} {c.cy}")
        inverse = np.linalg.inv(world.poses[i])
        vector = vector_from_rotation(inverse[:3, :3])
        rows.append([world.stamps[i] + 3000, *vector, *inverse[:3, 3]])
    text = "\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows)
    (path / "lowres_wide.traj").write_text(text)
    return path


def test_points_and_colours(recorded, save, tmp_path):
    world = recorded(turns=1, shrink=1)
    folder = tmp_path / VIDEO / f"{VIDEO}_frames"
    folder.mkdir(parents=True)
    write(folder, world, save)
    world.check(open_capture(folder))
    capture = open_capture(tmp_path / VIDEO)
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps + 3000, atol=1e-3)


def test_frames_that_lack_something_are_counted(recorded, save, tmp_path):
    world = recorded(turns=1)
    write(tmp_path, world, save)
    text = (tmp_path / "lowres_wide.traj").read_text().splitlines()
    (tmp_path / "lowres_wide.traj").write_text("\n".join(text[1:]))
    sorted((tmp_path / "lowres_depth").iterdir())[1].unlink()
    sorted((tmp_path / "lowres_wide_intrinsics").iterdir())[2].unlink()
    capture = open_capture(tmp_path)
    assert capture.left_out == {
        "no pose within 5 ms": 1, "no depth within 5 ms": 1, "no intrinsics within 5 ms": 1,
    }  # fmt: skip
    world.check(capture, [3])


BAD_CAMERAS = ("", "96 72 80", "96 72 80 80 48 nan", "a b c d e f", "0 72 1 1 1 1")
BAD_POSES = ("", "1 2 3", "1 nan 0 0 0 0 0")


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        *(("lowres_wide_intrinsics/*", text) for text in BAD_CAMERAS),
        *(("lowres_wide.traj", text) for text in BAD_POSES),
    ],
)
def test_a_wrong_file_is_named(pattern, text, recorded, save, tmp_path):
    file = next(write(tmp_path, recorded(turns=1), save).glob(pattern))
    file.write_text(text)
    with pytest.raises(InputError, match=file.name):
        open_capture(tmp_path)


def test_what_was_not_downloaded_and_names_without_stamps(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    for kind in ("lowres_wide", "lowres_depth", "lowres_wide_intrinsics"):
        (tmp_path / kind).rename(tmp_path / "elsewhere")
        with pytest.raises(InputError, match=rf"{kind} contains no file; download"):
            open_capture(tmp_path)
        (tmp_path / "elsewhere").rename(tmp_path / kind)
    save(tmp_path / "lowres_wide" / "thumbnail.png", recorded(turns=1).rgb[0])
    with pytest.raises(InputError, match=r"thumbnail.png: the file name has no stamp"):
        open_capture(tmp_path)
