"""Search boxes."""

import math

import pytest


def found(client, q, **more):
    return client.get("/api", params={"q": q} | more).json()["features"]


def test_names_have_photons_properties(client, town):
    import placegraph as pg

    city = pg.open_map(town)
    row = next(i for i in range(len(city.objects)) if "=" in city.objects.label(i)
               and city.objects.name(i).count(" ") == 1)  # fmt: skip
    name = city.objects.name(row)
    best = found(client, name)[0]
    assert best["properties"]["name"] == name
    assert set(best["properties"]) >= {"osm_type", "osm_id", "osm_key", "osm_value", "type"}
    assert best["properties"]["osm_type"] in "NWR"
    assert found(client, name[:-2].lower())[0]["properties"]["name"].startswith(name[:3])
    wrong = name[0] + name[2:]
    assert name in [f["properties"]["name"] for f in found(client, wrong)]


def test_what_is_near_comes_first(client):
    def distance(feature):
        lon, lat = feature["geometry"]["coordinates"]
        return ((lon - at[0]) * math.cos(math.radians(lat))) ** 2 + (lat - at[1]) ** 2

    everything = found(client, "bench", limit=50)
    at = everything[-1]["geometry"]["coordinates"]
    near = found(client, "bench", lon=at[0], lat=at[1], limit=50)
    distances = [distance(f) for f in near]
    assert distances == sorted(distances)
    assert len(near) == len(everything)
    assert len(found(client, "bench", limit=1)) == 1


def test_extents_run_from_the_north_west(client):
    extents = [f["properties"]["extent"] for f in found(client, "church") if
               "extent" in f["properties"]]  # fmt: skip
    assert extents
    for west, north, east, south in extents:
        assert west < east
        assert south < north


def test_a_sentence_is_located(client):
    text = "A bakery is north of me. The church is east of the bakery."
    best = found(client, text)[0]
    asked = client.post("/v1/locate", json={"text": text}).json()["estimate"]["modes"][0]
    assert best["geometry"]["coordinates"] == pytest.approx([asked["longitude"], asked["latitude"]])
    assert best["properties"]["osm_key"] == "placegraph"


def test_bad_searches(client):
    assert client.get("/api").json()["code"] == "fields"
    assert client.get("/api", params={"q": "a", "lat": 91}).status_code == 422
    assert found(client, "xqzzy") == []
    assert found(client, "?") == []
