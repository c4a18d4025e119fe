import sys

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph import build_city
from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.io.osm.osm import AREA, LINE, NODE, POINT, RELATION, WAY, LeftOut
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph_io import overture as overture_files
from placegraph_io.overture import (
    Box,
    Overture,
    is_overture,
    read_overture,
    tag_table,
    tags_of,
)

TYPES = {
    "": pa.string(), "number": pa.float64(), "int": pa.int32(), "bool": pa.bool_(),
    "blob": pa.binary(), "numbers": pa.list_(pa.float64()), "texts": pa.list_(pa.string()),
    "tags": pa.map_(pa.string(), pa.string()),
}  # fmt: skip


def columns(words):
    """Columns of text, or of another type where a colon and its name follow."""
    return [
        (name, TYPES[kind]) for name, _, kind in (word.partition(":") for word in words.split())
    ]


def struct(words):
    return pa.struct(columns(words))


TYPES["bbox"] = pa.struct([(edge, pa.float32()) for edge in ("xmin", "xmax", "ymin", "ymax")])
TYPES["rules"] = pa.list_(struct("variant language perspectives value between:numbers side"))
TYPES["names"] = struct("primary common:tags rules:rules")
SOURCE = "property dataset license record_id update_time confidence:number between:numbers"
TYPES["sources"] = pa.list_(struct(SOURCE))
TYPES["categories"] = struct("primary alternate:texts")
TYPES["taxonomy"] = struct("primary hierarchy:texts alternates:texts")
TYPES["addresses"] = pa.list_(struct("freeform locality postcode country"))
TYPES["brand"] = struct("wikidata names:names")
TYPES["parts"] = pa.list_(struct("value between:numbers"))
TYPES["connectors"] = pa.list_(struct("connector_id at:number"))
COMMON = "id geometry:blob bbox:bbox version:int sources:sources names:names "
SCHEMAS = {
    "place": "categories:categories basic_category taxonomy:taxonomy confidence:number brand:brand"
             " addresses:addresses operating_status",
    "building": "level:int subtype class height:number has_parts:bool num_floors:int",
    "segment": "subtype class subclass subclass_rules:parts connectors:connectors",
    "infrastructure": "subtype class source_tags:tags",
}  # fmt: skip
UUID = "b4c3b6a4-5dfb-4a3f-8a3c-{:012x}"


def row(wkt, i=0, **columns):
    shape = shapely.from_wkt(wkt)
    west, south, east, north = shapely.bounds(shape)
    bbox = {"xmin": west, "xmax": east, "ymin": south, "ymax": north}
    name = columns.pop("name", None)
    names = {"primary": name, "common": None, "rules": None} if name else None
    given = {"id": UUID.format(i), "geometry": shapely.to_wkb(shape), "bbox": bbox, "version": 1}
    return given | {"names": names} | columns


def place(lon, lat, i=0, category=None, **columns):
    categories = {"primary": category, "alternate": columns.pop("alternate", None)}
    known = {"categories": categories, "confidence": 0.9, "operating_status": "open"}
    return row(f"POINT ({lon} {lat})", i, **(known | columns))


def write(path, kind, rows, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        pa.Table.from_pylist(rows, pa.schema(columns(COMMON + SCHEMAS[kind]))), path, **options
    )
    return path


def read(*paths, **options):
    left_out = LeftOut()
    source = Overture(tuple(map(str, paths)), **options)
    return list(read_overture(source, left_out)), left_out.counts


@pytest.fixture
def release(tmp_path):
    square = "POLYGON ((10 50, 10.001 50, 10.001 50.001, 10 50.001, 10 50))"
    ring = square.replace(
        "))", "), (10.0002 50.0002, 10.0004 50.0002, 10.0004 50.0004, 10.0002 50.0002))"
    )
    write(
        tmp_path / "theme=places/type=place/part-0.zstd.parquet", "place",
        [
            place(10.0, 50.0, 1, "coffee_shop", name="Café Blau", alternate=["bakery"]),
            place(10.001, 50.0, 2, "korean_restaurant", name="Seoul"),
            place(10.002, 50.0, 3, "reiki_healing", name="Kraftort"),
            place(10.003, 50.0, 4, "reiki_healing"),
            place(10.004, 50.0, 5, "pharmacy", operating_status="permanently_closed"),
            place(10.005, 50.0, 6, "pharmacy", confidence=0.2),
        ],
    )  # fmt: skip
    write(
        tmp_path / "theme=buildings/type=building/part-0.zstd.parquet", "building",
        [
            row(square, 11, subtype="religious", **{"class": "church"}, name="Sankt Anna"),
            row(ring, 12),
            row(square, 13, **{"class": "spaceport"}),
        ],
    )  # fmt: skip
    line = "LINESTRING (10 50, 10.002 50.001)"
    write(
        tmp_path / "theme=transportation/type=segment/part-0.zstd.parquet", "segment",
        [
            row(line, 21, subtype="road", **{"class": "primary"}, subclass="link"),
            row(line, 22, subtype="road", **{"class": "footway"}, subclass_rules=[{"value": "sidewalk"}]),
            row(line, 23, subtype="rail", **{"class": "tram"}, name="Linie 8"),
            row(line, 24, subtype="water"),
        ],
    )  # fmt: skip
    write(
        tmp_path / "theme=base/type=infrastructure/part-0.zstd.parquet", "infrastructure",
        [row("POINT (10.0005 50.0005)", 31, source_tags=[("amenity", "bench")])],
    )  # fmt: skip
    other = tmp_path / "theme=transportation/type=connector/part-0.zstd.parquet"
    other.parent.mkdir(parents=True)
    other.write_bytes(b"never opened")
    return tmp_path


def test_rows_become_the_elements_that_openstreetmap_would_have(release):
    elements, left_out = read(release)
    found = {-e.osm_id - 1 & 0xFFF: e for e in elements}
    assert sorted(found) == [1, 2, 3, 0x0B, 0x0C, 0x0D, 0x15, 0x16, 0x17, 0x1F]
    assert found[1].tags == {"amenity": "cafe", "shop": "bakery", "name": "Café Blau"}
    assert (found[1].osm_type, found[1].kind) == (NODE, POINT)
    np.testing.assert_array_equal(found[1].parts, [[[10.0, 50.0]]])
    assert found[2].tags == {"amenity": "restaurant", "cuisine": "korean", "name": "Seoul"}
    assert found[3].tags == {"name": "Kraftort"}
    assert found[0x0B].tags == {"building": "church", "name": "Sankt Anna"}
    areas = [(found[i].osm_type, found[i].kind) for i in (0x0B, 0x0C)]
    assert areas == [(WAY, AREA), (RELATION, AREA)]
    assert [len(part) for part in found[0x0C].parts] == [5, 4]
    assert found[0x0D].tags == {"building": "yes"}
    assert found[0x15].tags == {"highway": "primary_link"}
    assert found[0x16].tags == {"highway": "footway", "footway": "sidewalk"}
    assert (found[0x17].tags, found[0x17].kind) == ({"railway": "tram", "name": "Linie 8"}, LINE)
    assert found[0x1F].tags == {"amenity": "bench"}
    nothing = r"1 files of connector\. Give west,south,east,north of an area"
    with pytest.raises(InputError, match=nothing):
        read(release, box=Box(0, 0, 1, 1))
    assert left_out == {
        "places stored by name only, because no tag matches their category": 1,
        "places whose class has no matching tag": 1,
        "places permanently closed": 1,
        "places below the confidence limit": 1,
        "buildings whose class has no matching tag": 1,
        "segments whose class has no matching tag": 1,
        "files of connector": 1,
    }


def test_a_city_is_built_of_it(release, tmp_path):
    city = build_city(Overture((str(release),), Box(9.9, 49.9, 10.1, 50.1)), tmp_path / "x.city")
    assert {"amenity=cafe", "building=church", "highway=primary_link"} <= set(city.objects.labels)
    assert city.locate("I see a church and a cafe. A bench is near.").modes
    assert city.left_out["places below the confidence limit"] == 1


def test_every_tag_of_the_table_is_a_label_of_the_vocabulary():
    vocabulary = Vocabulary.default()
    for (kind, field, value), tags in tag_table().items():
        filled = tags.replace("{}", value).replace("{*}", "x").replace("{class}", "primary")
        pairs = dict(tag.split("=") for tag in filled.split())
        if kind == "segment" and field == "subclass":
            pairs = {"highway": "service"} | pairs
        found = vocabulary.labels_of(pairs)
        assert set(found) >= {f"{k}={v}" for k, v in pairs.items()} - {"building=yes"}, value


def test_older_and_newer_ways_to_say_a_category():
    hierarchy = ["food_and_drink", "cafe", "sea_view_cafe"]
    newer = {"taxonomy": {"primary": "sea_view_cafe", "hierarchy": hierarchy}}
    assert tags_of("place", newer)[0] == {"amenity": "cafe"}
    assert tags_of("place", {"basic_category": "bookstore"})[0] == {"shop": "books"}
    older = {"categories": {"primary": "hotel", "alternate": None}}
    assert tags_of("place", older)[0] == {"tourism": "hotel"}


def test_names_brands_and_addresses():
    rules = [{"variant": "alternate", "value": "Kaisers"}, {"variant": "alternate", "value": "KT"}]
    common = [("fr", "Chez Kaiser"), ("zh-Hant-TW", "?")]
    names = {"primary": "Kaiser's", "common": common, "rules": rules}
    brand = {"names": {"primary": "Tengelmann"}}
    told = {"names": names, "brand": brand, "basic_category": "supermarket"}
    for freeform in ("12a Rue de la Paix, 2e étage", "Rue de la Paix 12a"):
        tags, _ = tags_of("place", told | {"addresses": [{"freeform": freeform}]})
        assert tags == {
            "shop": "supermarket", "name": "Kaiser's", "name:fr": "Chez Kaiser", "alt_name": "Kaisers;KT",
            "brand": "Tengelmann", "addr:housenumber": "12a", "addr:street": "Rue de la Paix",
        }  # fmt: skip


def test_only_row_groups_that_meet_the_box_are_read(tmp_path, monkeypatch):
    rows = [place(i * 0.01, 50.0, i, "cafe") for i in range(100)]
    path = write(tmp_path / "p.parquet", "place", rows, row_group_size=10)
    opened = []
    real = pq.ParquetFile.iter_batches

    def watched(self, size, groups, *rest, **more):
        opened.extend(groups)
        return real(self, size, groups, *rest, **more)

    monkeypatch.setattr(pq.ParquetFile, "iter_batches", watched)
    elements, _ = read(path, box=Box(0.145, 49.0, 0.235, 51.0))
    assert opened == [1, 2]
    found = sorted(e.parts[0][0, 0] for e in elements)
    assert found == pytest.approx([0.01 * i for i in range(15, 24)])


def test_a_huge_row_group_is_read_piece_by_piece(tmp_path):
    rows = [place(i * 1e-5, 50.0, i, "cafe", name=f"{i:05d}" * 400) for i in range(20_000)]
    options = {"row_group_size": len(rows), "compression": "none", "use_dictionary": False}
    path = write(tmp_path / "p.parquet", "place", rows, **options)
    del rows
    elements = read_overture(Overture((str(path),)))
    next(elements)
    before = pa.total_allocated_bytes()
    held = max(pa.total_allocated_bytes() for _ in elements)
    assert path.stat().st_size > 40e6
    assert held < before + 25e6


def test_files_by_url(release):
    memory = fsspec.filesystem("memory")
    name = "theme=places/type=place/part-0.zstd.parquet"
    memory.pipe(f"/release/{name}", (release / name).read_bytes())
    assert len(read("memory://release")[0]) == 3
    assert len(read(f"file://{release}/{name}")[0]) == 3
    assert is_overture("memory://release")
    with pytest.raises(OptionError, match="this kind of URL is not supported"):
        read("gopher://release")


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((7.5, 43.7, 7.4, 43.8), "Exchange them"), ((7.4, 43.8, 7.5, 43.7), "Exchange them"),
        ((43.7, 97.4, 43.8, 97.5), "out of range"), ((7.4, 43.7), "four numbers"),
        ((7.4, 43.7, float("nan"), 43.8), "four numbers"),
    ],
)  # fmt: skip
def test_a_box_that_is_none(numbers, said):
    with pytest.raises(OptionError, match=said):
        Box.of(numbers)


def test_a_missing_column_is_named(tmp_path):
    file = write(tmp_path / "p.parquet", "place", [place(10, 50, 1, "cafe")])
    for column in ("id", "geometry", "bbox", "names"):
        pq.write_table(pq.read_table(file).drop([column]), tmp_path / "q.parquet")
        with pytest.raises(InputError, match=f"q.parquet lacks the column {column}"):
            read(tmp_path / "q.parquet")


def test_another_schema(tmp_path):
    pq.write_table(pa.table({"id": ["a"], "price": [1.0]}), tmp_path / "sales.parquet")
    with pytest.raises(InputError, match="rows of no known type"):
        read(tmp_path / "sales.parquet")
    (tmp_path / "type=division").mkdir()
    pq.write_table(pa.table({"id": ["a"]}), tmp_path / "type=division/part.parquet")
    with pytest.raises(InputError, match="contains division"):
        read(tmp_path / "type=division/part.parquet")
    with pytest.raises(InputError, match="1 files of division, 1 files of no known type"):
        read(tmp_path)


@pytest.mark.parametrize("column", ["names", "categories", "brand", "addresses", "bbox"])
def test_columns_of_another_type(tmp_path, column):
    write(tmp_path / "p.parquet", "place", [place(10, 50, 1, "cafe", name="A")])
    table = pq.read_table(tmp_path / "p.parquet")
    at = table.schema.get_field_index(column)
    pq.write_table(table.set_column(at, column, pa.array(["x"])), tmp_path / "p.parquet")
    with pytest.raises(InputError, match=r"p\.parquet"):
        read(tmp_path / "p.parquet", box=Box(9, 49, 11, 51))


@pytest.mark.parametrize("content", [b"", b"PAR1", b"<osm/>", b"PAR1" + bytes(99) + b"PAR1"])
def test_no_parquet(content, tmp_path):
    (tmp_path / "p.parquet").write_bytes(content)
    with pytest.raises(InputError, match=r"p.parquet cannot be read as Parquet"):
        read(tmp_path / "p.parquet")
    (tmp_path / "p.parquet").unlink()
    with pytest.raises(InputError, match="does not exist"):
        read(tmp_path / "p.parquet")
    with pytest.raises(InputError, match="contains no Parquet file"):
        read(tmp_path)
    assert not is_overture(str(tmp_path))


def test_geometry_that_is_no_wkb_is_counted(tmp_path):
    bad = [
        place(10, 50, 2, "cafe") | {"geometry": b"\x01\x02"},
        place(10, 50, 3, "cafe") | {"geometry": None},
        place(10, 95, 4, "cafe"),
        place(10, 50, 5, "cafe") | {"geometry": shapely.to_wkb(shapely.Point(np.nan, 1.0))},
        place(10, 50, 6, "cafe") | {"geometry": shapely.to_wkb(shapely.from_wkt("POINT EMPTY"))},
        row("GEOMETRYCOLLECTION (POINT (1 1))", 7) | {"categories": {"primary": "cafe"}},
    ]  # fmt: skip
    elements, left_out = read(
        write(tmp_path / "p.parquet", "place", [place(10, 50, 1, "cafe"), *bad])
    )
    table = pq.read_table(tmp_path / "p.parquet")
    text = table.set_column(1, "geometry", pa.array(["POINT (10 50)"] * len(table)))
    pq.write_table(text, tmp_path / "q.parquet")
    with pytest.raises(InputError, match="geometry is string, not WKB"):
        read(tmp_path / "q.parquet")
    assert len(elements) == 1
    assert sum(left_out.values()) == len(bad)
    assert left_out["places whose geometry is not WKB"] == 2


@given(st.binary(max_size=64))
def test_any_bytes_as_geometry(tmp_path_factory, blob):
    path = tmp_path_factory.mktemp("any") / "p.parquet"
    rows = [place(10, 50, 1, "cafe"), place(10, 50, 2, "cafe") | {"geometry": blob}]
    elements, left_out = read(write(path, "place", rows))
    assert len(elements) + sum(left_out.values()) == 2


@DAMAGE
@given(st.data())
def test_a_damaged_file_is_read_or_refused(tmp_path, data):
    path = tmp_path / "p.parquet"
    write(path, "place", [place(10 + i * 1e-3, 50, i, "cafe", name="x" * i) for i in range(50)])
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    with refusing("p.parquet"):
        assert read(path)[0]


def test_a_footer_that_ends_pyarrow_ends_another_process(tmp_path, monkeypatch):
    path = write(tmp_path / "p.parquet", "place", [place(0.2, 50.0, 0, "cafe")])
    monkeypatch.setattr(overture_files, "_STATISTICS_CHECK", "import os; os.abort()")
    with pytest.raises(
        InputError, match=r"p\.parquet is damaged: PyArrow crashes .*, with Aborted"
    ):
        read(path, box=Box(0.0, 49.0, 1.0, 51.0))


def test_without_pyarrow(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[overture\]"):
        read("p.parquet")
