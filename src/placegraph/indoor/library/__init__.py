"""Many scenes, and the question in which of them one is (Sec. 4).

`SceneLibrary` holds them: `add`, `remove`, `search` by a capture or a text, `localize`, `save`. How
to: `docs/howto-library.md`; the method: `docs/indoor.md`.
"""

from placegraph.indoor.library.library import SceneLibrary, make_library
from placegraph.indoor.library.search import SearchOptions

__all__ = ["SceneLibrary", "SearchOptions", "make_library"]
