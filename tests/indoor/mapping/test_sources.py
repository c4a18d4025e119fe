from collections import Counter

import pytest

from placegraph.errors import InputError, MissingExtraError
from placegraph.indoor.mapping import sources
from placegraph.indoor.mapping.export import export
from placegraph.indoor.mapping.sources import ReadOptions, read_source, source_formats


def test_what_tells_little_is_asked_last():
    kinds = source_formats()
    assert [kind.ending for kind in kinds[:3]] == [".glb", ".gltf", ".obj"]
    assert kinds[-1].ending == ".ply"
    assert {kind.verb for kind in kinds if kind.is_graph} == {"spark_dsg", "conceptgraphs"}


def test_without_its_plugin_a_folder_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "plugins", lambda _: {})
    assert [kind.ending for kind in source_formats()] == [".glb", ".gltf", ".obj", ".ply"]
    (tmp_path / "graph.json").write_text("{}")
    for path in (tmp_path, tmp_path / "graph.json"):
        with pytest.raises(InputError, match=r"placegraph\[io\]"):
            read_source(path, ReadOptions(), Counter())


def test_without_its_plugin_no_scene_graph_is_written(room, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "placegraph_io.graphs.spark_dsg_write", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[io\]"):
        export(room, tmp_path / "room.json")
