import sys
from pathlib import Path

import placegraph

HOME = Path(placegraph.__file__).parent
MOST = 35
"""Files that a sentence enters at most, from `CityMap.locate` to the estimate, evidence included."""
FIRST = "A café is south of me. I am on Lange Straße, 40 m from the library. There is no fountain."
"""What derives a map's indexes and compiles."""
SENTENCES = (
    "A bakery is north of me. The church is east of the bakery.",
    "I am on Speicherweg, about 50 m from the museum. There is no bench here.",
)


def test_a_sentence_passes_few_files(harbour):
    harbour.locate(FIRST).to_dict()
    entered = set()

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(str(HOME)):
            entered.add(Path(frame.f_code.co_filename).relative_to(HOME).as_posix())

    sys.setprofile(note)
    try:
        for text in SENTENCES:
            harbour.locate(text).to_dict()
    finally:
        sys.setprofile(None)
    assert len(entered) <= MOST, "\n".join(sorted(entered))
