import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, any_json, damaged, refusing

from placegraph.errors import InputError, OptionError
from placegraph_io.dataset.scannet import (
    axis_alignment,
    is_scannet,
    read_label_map,
    read_scannet,
)

SEGMENTS = "_vh_clean_2.0.010000.segs.json"


@pytest.fixture
def scan(scannet_world, tmp_path):
    return scannet_world.Scan(tmp_path / "scans" / scannet_world.NAME)


def letters(model, scan):
    drawn = [scan.mesh.letters[a] for a in scan.mesh.triangles[:, 0]]
    return [(model.objects[i].label, d) for i, d in zip(model.object_of, drawn, strict=True)]


def test_objects_are_those_of_the_annotation_in_the_map_s_axes(scan):
    model = read_scannet(scan.folder)
    np.testing.assert_allclose(model.vertices, scan.mesh.points, atol=5e-6)
    np.testing.assert_array_equal(model.triangles, scan.mesh.triangles)
    np.testing.assert_array_equal(model.colours, scan.mesh.colours)
    assert set(letters(model, scan)) == {
        ("floor", "f"), ("dining table", "t"), ("office chair", "c"), ("unknown", "w"),
    }  # fmt: skip
    assert [t.id for t in model.objects] == ["0", "4", "2", "unknown"]
    assert model.left_out == {"vertices without an object": scan.mesh.letters.count("w")}
    assert model.path == scan.folder


def test_alignment_is_an_option_and_absent_in_test_scans(scan):
    np.testing.assert_allclose(
        read_scannet(scan.folder, align=False).vertices, scan.points, atol=1e-6
    )
    scan.text(".txt", "sceneType = Office\n")
    np.testing.assert_allclose(read_scannet(scan.folder).vertices, scan.points, atol=1e-6)
    scan.file(".txt").unlink()
    np.testing.assert_array_equal(axis_alignment(scan.folder), np.eye(4))


@pytest.mark.parametrize(
    "said", ["1 2 3", "a " * 16, "2 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "nan " * 16, "1 " * 16]
)
def test_an_alignment_that_is_no_motion_is_refused(scan, said):
    scan.text(".txt", f"axisAlignment = {said}\n")
    with pytest.raises(InputError, match=r"scene0000_00\.txt: axisAlignment is not a rigid"):
        read_scannet(scan.folder)


def test_the_hi_res_mesh_serves_where_the_decimated_one_is_missing(scan):
    scan.write_mesh("_vh_clean.ply")
    scan.write_segments("_vh_clean.segs.json", [s + 1 for s in scan.mesh.segments])
    renamed = [g | {"segments": [s + 1 for s in g["segments"]]} for g in scan.groups]
    scan.write_groups("_vh_clean.aggregation.json", renamed)
    given_ = read_scannet(scan.file("_vh_clean.ply"))
    scan.file("_vh_clean_2.ply").unlink()
    for model in (given_, read_scannet(scan.folder)):
        assert ("dining table", "t") in letters(model, scan)


def test_labels_come_from_a_column_of_the_table(scan):
    scan.write_table()
    scan.write_groups(".aggregation.json", [*scan.groups[1:], scan.groups[0] | {"label": "object"}])
    model = read_scannet(scan.folder, label_column="category")
    said = {t.id: (t.label, t.attributes.get("raw_category")) for t in model.objects}
    assert said["4"] == ("table", "dining table")
    assert said["2"] == ("chair", "office chair")
    assert said["0"] == ("object", "object")  # an empty cell leaves the raw label
    assert model.left_out["labels that the table does not map"] == 1


def test_a_table_may_be_given_and_is_missed(scan, tmp_path):
    with pytest.raises(InputError, match=r"scannetv2-labels\.combined\.tsv"):
        read_scannet(scan.folder, label_column="nyu40class")
    table = scan.write_table().rename(tmp_path / "own.tsv")
    model = read_scannet(scan.folder, label_column="nyu40class", label_table=table)
    assert {t.label for t in model.objects} == {"floor", "table", "chair", "unknown"}
    with pytest.raises(OptionError, match=r"label_column is 'wordnet'; .*nyu40id, nyu40class"):
        read_scannet(scan.folder, label_column="wordnet", label_table=table)


@pytest.mark.parametrize("text", ["", "a,b\n", "id\traw_category\nx\tchair\n"])
def test_a_table_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "labels.tsv").write_text(text)
    with pytest.raises(InputError, match=r"labels\.tsv"):
        read_label_map(tmp_path / "labels.tsv")


def test_short_rows_of_the_table_are_empty_cells(scan):
    table = scan.write_table(["7\tlamp", "", "8\tbed\tbed\t1\t4\tbed"])
    labels = read_label_map(table, "nyu40class")
    assert labels.of_raw == {"bed": "bed"}
    assert labels.of_id == {7: "lamp", 8: "bed"}


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (
            "_vh_clean_2.ply",
            r"has no scene0000_00_vh_clean_2\.ply; labels alone are not enough for a",
        ),
        (
            ".aggregation.json",
            r"has no scene0000_00\.aggregation\.json; download it, or give .*_2\.ply",
        ),
        (SEGMENTS, r"has no scene0000_00_vh_clean_2\.0\.010000\.segs\.json; download"),
    ],
)
def test_a_missing_file_is_named_with_a_mend(scan, gone, message):
    scan.file(gone).unlink()
    assert is_scannet(scan.folder)
    assert not is_scannet(scan.file("_vh_clean_2.ply"))  # a mesh like any other
    with pytest.raises(InputError, match=message):
        read_scannet(scan.folder)


@pytest.mark.parametrize(
    "segments", [None, "1 2", [1.5] * 9, ["a"], [[1], [2, 3]], [1e400], [None]]
)
def test_segments_that_do_not_fit_are_refused(scan, segments):
    count = len(scan.mesh.segments)
    scan.write_segments(SEGMENTS, scan.mesh.segments[:-1])
    with pytest.raises(InputError, match=f"segments of {count - 1} vertices, but .* has {count};"):
        read_scannet(scan.folder)
    scan.json(SEGMENTS, {"segIndices": segments})
    with pytest.raises(InputError, match=r"has no list `segIndices` of numbers"):
        read_scannet(scan.folder)


@pytest.mark.parametrize(
    "groups",
    [
        None, {}, [3], [{"objectId": 1, "label": "x"}], [{"label": "x", "segments": [1]}],
        [{"objectId": 1, "label": "x", "segments": [1.0]}],
        [{"objectId": "1", "label": "x", "segments": [1]}],
        [{"objectId": 1, "label": 5, "segments": [1]}],
        [{"objectId": 1, "label": "x", "segments": []}, {"objectId": 1, "label": "y", "segments": []}],
    ],
)  # fmt: skip
def test_an_aggregation_that_is_none_is_refused(scan, groups):
    scan.json(".aggregation.json", {"segGroups": groups})
    with pytest.raises(InputError, match=r"scene0000_00\.aggregation\.json"):
        read_scannet(scan.folder)


def test_absent_segments_are_counted_and_all_absent_refused(scan):
    groups = [g | {"segments": [*g["segments"], 7, 8]} for g in scan.groups[:1]] + scan.groups[1:]
    scan.write_groups(".aggregation.json", groups)
    assert read_scannet(scan.folder).left_out["segments that the mesh does not have"] == 2
    scan.write_groups(".aggregation.json", [g | {"segments": [7]} for g in scan.groups[:1]])
    with pytest.raises(InputError, match="have no segment in common"):
        read_scannet(scan.folder)
    scan.write_groups(".aggregation.json", [])
    model = read_scannet(scan.folder)
    assert [t.label for t in model.objects] == ["unknown"]
    assert not model.object_of.any()


def test_a_segment_of_two_objects_is_the_last_one_s(scan):
    chair = next(g for g in scan.groups if g["label"] == "office chair")
    table = next(g for g in scan.groups if g["label"] == "dining table")
    chair["segments"] = chair["segments"] + table["segments"]
    scan.write_groups(".aggregation.json")
    model = read_scannet(scan.folder)
    assert ("office chair", "t") in letters(model, scan)
    count = len(table["segments"])
    assert model.left_out["segments that belong to several objects"] == count


def test_a_folder_of_several_scans_is_refused(scannet_world, tmp_path):
    for name in ("scene0001_00", "scene0001_01"):
        scannet_world.Scan(tmp_path / "all", name=name)
    with pytest.raises(InputError, match="contains several scans"):
        read_scannet(tmp_path / "all")
    assert read_scannet(tmp_path / "all" / "scene0001_01_vh_clean_2.ply").path.suffix == ".ply"


def test_what_is_no_scan_is_told(tmp_path):
    (tmp_path / "mesh.ply").write_bytes(b"ply")
    for path in (tmp_path, tmp_path / "mesh.ply", tmp_path / "none", tmp_path / "a\0b"):
        assert not is_scannet(path)
    for path in (tmp_path / "mesh.ply", tmp_path / "none"):
        with pytest.raises(InputError, match="folder of a ScanNet scan"):
            read_scannet(path)


WIDE = """
wwwwwwwwwwww
ffffffffffff
fttttffttttf
fttttfctttcf
fttttffttttf
fttttffttttf
ffffffffffff
"""


@pytest.fixture
def wide(scannet_world, tmp_path):
    scan = scannet_world.Scan(tmp_path / scannet_world.NAME, scannet_world.Mesh(WIDE))
    scan.file(".aggregation.json").unlink()
    scan.write_labels()
    return scan


def test_without_objects_connected_patches_of_a_class_are_objects(wide):
    model = read_scannet(wide.folder)
    assert [(t.id, t.label) for t in model.objects] == [
        ("1", "wall"), ("2", "floor"), ("3", "table"), ("4", "table"), ("unknown", "unknown"),
    ]  # fmt: skip
    tables = [np.unique(model.object_of[np.array([d == "t" for _, d in letters(model, wide)])])]
    assert np.concatenate(tables).tolist() == [2, 3]
    assert {d for label, d in letters(model, wide) if label == "unknown"} == {"c"}
    assert model.left_out["patches of fewer than 20 vertices"] == 2
    np.testing.assert_array_equal(model.colours, wide.mesh.colours)
    np.testing.assert_allclose(model.vertices, wide.mesh.points, atol=5e-6)


def test_colours_of_a_legend_are_none_and_labels_are_needed(wide):
    wide.file("_vh_clean_2.ply").unlink()
    model = read_scannet(wide.folder)
    assert (model.colours == 255).all()
    assert model.left_out["colours that encode classes"] == len(model.vertices)
    wide.write_mesh("_vh_clean_2.labels.ply")
    with pytest.raises(InputError, match=r"labels\.ply has no vertices with a `label`"):
        read_scannet(wide.folder)


@DAMAGE
@given(st.data())
def test_damage_is_an_input_error(scan, data):
    ending = data.draw(st.sampled_from(["_vh_clean_2.ply", SEGMENTS, ".aggregation.json", ".txt"]))
    whole = scan.file(ending).read_bytes()
    scan.file(ending).write_bytes(data.draw(damaged(whole)))
    with refusing(scan.folder):
        model = read_scannet(scan.folder)
        assert len(model.object_of) == len(model.triangles)
        assert not len(model.object_of) or model.object_of.max() < len(model.objects)
    scan.file(ending).write_bytes(whole)


@DAMAGE
@given(any_json("segGroups", "segIndices", "objectId", "label"))
def test_json_of_any_kind_is_read_or_refused(scan, content):
    for ending in (SEGMENTS, ".aggregation.json"):
        whole = scan.file(ending).read_text()
        scan.text(ending, json.dumps(content))
        with refusing(scan.name):
            read_scannet(scan.folder)
        scan.text(ending, whole)
