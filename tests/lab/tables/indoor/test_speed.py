from placegraph_lab.tables.named import indoor_speed as script
from placegraph_lab.tables.runner import Run, render


def test_methods_are_timed_on_both_maps(monkeypatch, tmp_path):
    measured = {
        "frame_seconds": 0.2, "stage_seconds": {"filter": 0.03, "search": 0.1},
        "passes": 3, "particles": 90.0, "rays_a_frame": 2e5, "rays_per_second": 1e7,
        "scoring_share": 0.5, "peak_bytes": 4e8,
    }  # fmt: skip
    monkeypatch.setattr(script, "run_apart", lambda *_: measured)
    run = Run("indoor_speed", tmp_path, tmp_path)
    rows = script.methods(run, {"house": tmp_path, "small": tmp_path}, [tmp_path])
    assert len(rows) == len(script.METHODS) + 2
    text = render(script.LOCALIZING, rows)
    assert "10.0 ms" in text  # a frame and pass
    assert "10.0 |     .50 | 400 MB" in text
