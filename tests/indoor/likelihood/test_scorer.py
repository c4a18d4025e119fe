"""Scores of poses, alone and as a rig, and what they cost."""

import numpy as np
import pytest
from tests.indoor.conftest import view_frames

from placegraph.core.geometry import compose
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.options import PoseSearchOptions

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions()


@pytest.fixture(scope="module")
def seen(room, walk):
    return view_frames(room, walk[:3], OPTIONS, stride=20.0)


def test_scores_are_counted(room, seen):
    scorer = Scorer(room, OPTIONS.likelihood)
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    terms = scorer.terms(poses, seen[0])
    assert terms.shape == (2, 4)
    assert scorer.poses == 2
    assert scorer.rays == 2 * len(seen[0].directions)
    values = scorer(poses, seen[0])
    np.testing.assert_allclose(values, scorer.model.combine_terms(terms, seen[0].terms))
    assert scorer.poses == 4
    assert scorer.seconds > 0


def test_a_sequence_is_scored_as_a_rig(room, seen):
    scorer = Scorer(room, OPTIONS.likelihood)
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    steps = np.array([[0, 0, 0, 0], [0.2, 0.1, 0, 0.3], [-0.1, 0, 0.02, -1.0]])
    expected = sum(scorer(compose(poses, s), v) for s, v in zip(steps, seen, strict=True))
    np.testing.assert_allclose(scorer.together(poses, seen, steps), expected)
    with pytest.raises(ValueError, match="shorter"):
        scorer.together(poses, seen, steps[:2])
