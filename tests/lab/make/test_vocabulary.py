import hashlib
import json
import lzma

import pytest

from placegraph.errors import InputError
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.vocabulary.tables import Lexicon
from placegraph_lab.make.vocabulary import ENGLISH, WORLD, write_lexicons


@pytest.fixture
def package(tmp_path):
    root = tmp_path / "package"
    translations = root / "dist" / "translations"
    translations.mkdir(parents=True)
    presets = {
        "amenity/cafe": {"tags": {"amenity": "cafe"}},
        "leisure/pitch/tennis": {"tags": {"leisure": "pitch", "sport": "tennis"}},
        "amenity/clinic/x": {"tags": {"amenity": "clinic", "healthcare:speciality": "x"}},
        "type/route": {"tags": {"type": "route"}},
        "@templates/poi": {"tags": {"@template": "poi"}},
    }
    (root / "dist" / "presets.min.json").write_text(json.dumps(presets))
    (root / "LICENSE.md").write_text("ISC\n")
    english = {
        "amenity/cafe": {"name": "Cafe", "aliases": "Café Bar\nTea Room", "terms": "latte,tea"},
        "leisure/pitch/tennis": {"name": "Tennis Court / Field (outdoor)"},
        "amenity/clinic/x": {"name": "X Clinic", "terms": "<translate>"},
        "type/route": {"name": "Route"},
    }
    german = {"amenity/cafe": {"name": "Kaffeeklause", "terms": "kaffee,ein sehr langer Ausdruck"}}
    for language in (*ENGLISH, *WORLD):
        texts = {"en": english, "de": german}.get(language, {})
        body = {language: {"presets": {"presets": texts}}}
        (translations / f"{language}.min.json").write_text(json.dumps(body))
    return root


def make(package, output):
    told = []
    write_lexicons(package, output, told.append)
    assert all("words" in line for line in told)
    return {path.name: path.read_bytes() for path in output.iterdir()}


def test_lexicons_are_deterministic_and_right(package, tmp_path):
    first = make(package, tmp_path / "one")
    second = make(package, tmp_path / "two")
    assert {k: hashlib.sha256(v).digest() for k, v in first.items()} == {
        k: hashlib.sha256(v).digest() for k, v in second.items()
    }
    assert set(first) == {"english.tsv.xz", "world.tsv.xz", "LICENSE-id-tagging-schema.md"}
    english = Lexicon(lzma.decompress(first["english.tsv.xz"]).decode())
    assert english.senses("cafe") == {"amenity=cafe": 1.0}
    assert english.senses("tea room") == {"amenity=cafe": 0.95}
    assert english.senses("latte") == {"amenity=cafe": 0.7}
    assert english.senses("tennis field") == {"leisure=pitch": 0.34, "sport=tennis": 0.85}
    assert english.names("en")["leisure=pitch@0.4 sport=tennis"] == "tennis court"
    assert english.senses("x clinic") == {"amenity=clinic": 0.6}
    assert english.senses("route") == {}
    world = Lexicon(lzma.decompress(first["world.tsv.xz"]).decode())
    assert set(world.words()) == {"kaffeeklause", "kaffee"}
    (tmp_path / "one" / "LICENSE-id-tagging-schema.md").unlink()
    mine = Vocabulary.load(tmp_path / "one")
    assert [sense.label for sense in mine.senses("Kaffeeklause")] == ["amenity=cafe"]
    assert world.names("de") == {"amenity=cafe": "kaffeeklause"}


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="unpacked npm package"):
        write_lexicons(tmp_path, tmp_path / "out", print)
