"""The losses by hand."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")

from placegraph_learn.train.city.objective import (  # noqa: E402
    Scores,
    Temperatures,
    Truth,
    contrastive,
    losses,
)
from placegraph_learn.train.city.options import LOSSES, PRINTED  # noqa: E402


def tensor(numbers):
    return torch.tensor(numbers, dtype=torch.float32)


def scales(value=0.0):
    return Temperatures(tensor([value]), tensor([value]), tensor(1.0))


def test_contrastive_is_minus_log_share_of_what_is_right():
    scores, right = tensor([[1.0, 2.0, 0.5]]), torch.tensor([[1, 0, 0]])
    expected = -np.log(np.exp(1.0) / np.exp([1.0, 2.0, 0.5]).sum())
    assert float(contrastive(scores, right)) == pytest.approx(expected)


def test_several_right_ones_count_together():
    scores, right = tensor([[1.0, 2.0, 0.5]]), torch.tensor([[1, 1, 0]])
    e = np.exp([1.0, 2.0, 0.5])
    assert float(contrastive(scores, right)) == pytest.approx(-np.log((e[0] + e[1]) / e.sum()))


def test_what_is_near_does_not_count_whatever_its_score():
    scores, right = tensor([[1.0, 2.0, 0.5]]), torch.tensor([[1, -1, 0]])
    e = np.exp([1.0, 0.5])
    expected = -np.log(e[0] / e.sum())
    assert float(contrastive(scores, right)) == pytest.approx(expected)
    scores[0, 1] = 50.0
    scores.requires_grad_()
    loss = contrastive(scores, right)
    assert float(loss.detach()) == pytest.approx(expected)
    loss.backward()
    assert scores.grad[0, 1] == 0.0


def test_texts_with_nothing_to_tell_apart_do_not_count():
    scores = tensor([[1.0, 2.0], [5.0, 5.0], [0.0, 3.0]])
    right = torch.tensor([[1, 0], [1, -1], [0, 0]])
    alone = contrastive(scores[:1], right[:1])
    assert float(contrastive(scores, right)) == pytest.approx(float(alone))
    assert float(contrastive(scores[1:], right[1:])) == 0.0


@pytest.fixture
def two_texts():
    """Text 0 has places 0, 1, text 1 places 2, 3; place 3 is near, and place 2 right for both."""
    scores = Scores(
        tensor([2.0, -1.0, 0.5, 4.0]),
        tensor([0.9, 0.1, 0.3, 0.8]),
        tensor([[0.9, 0.1, 0.2, 0.0], [0.4, 0.3, 0.6, 0.9]]),
        tensor([1.0, 2.0, 0.0, 0.0]),
    )
    everywhere = torch.tensor([[1, 0, 1, 0], [0, 0, 1, -1]])
    relational = tensor([3.0, 1.5, np.nan, 2.0])
    return scores, Truth(
        torch.tensor([0, 0, 1, 1]), torch.tensor([1, 0, 1, -1]), everywhere, relational
    )


def test_losses_by_hand(two_texts):
    found = losses(*two_texts, scales(1.0))
    assert found.keys() == set(LOSSES)

    def sigmoid(x):
        return 1.0 / (1.0 + np.exp(-x))

    binary = -np.log([sigmoid(2.0), 1.0 - sigmoid(-1.0), sigmoid(0.5)]).mean()
    e = np.exp([2.0, -1.0])
    # of text 1 nothing is wrong: only text 0 ranks
    assert float(found["match"]) == pytest.approx(binary - np.log(e[0] / e.sum()))
    e = np.exp(np.e * np.array([0.9, 0.1]))
    assert float(found["similarity"]) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)
    e = np.exp([3.0 + 1.0, 1.5 + 2.0])
    assert float(found["fusion"]) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)
    first, second = (np.exp(np.e * np.array(x)) for x in ([0.9, 0.2, 0.1, 0.0], [0.6, 0.4, 0.3]))
    expected = -np.log([first[:2].sum() / first.sum(), second[0] / second.sum()]).mean()
    assert float(found["embedding"]) == pytest.approx(expected, rel=1e-5)


def test_perfect_scores_cost_nothing_and_wrong_ones_much(two_texts):
    """The published loss is nearly flat: all equal 83.2, perfect 81.5."""
    truth = two_texts[1]._replace(relational=torch.zeros(4))
    signs = torch.where(truth.right == 1, 1.0, -1.0)
    everywhere = torch.where(truth.everywhere == 1, 1.0, -1.0)
    perfect = losses(Scores(30.0 * signs, signs, everywhere, 30.0 * signs), truth, scales(3.0))
    wrong = losses(Scores(-30.0 * signs, -signs, -everywhere, -30.0 * signs), truth, scales(3.0))
    equal = losses(
        Scores(0.0 * signs, 0.0 * signs, 0.0 * everywhere, 0.0 * signs), truth, scales(3.0)
    )
    for name in LOSSES:
        assert float(perfect[name]) < 1e-4
        assert 0.3 < float(equal[name]) < 2.0
        assert float(wrong[name]) > 10.0


@pytest.mark.parametrize("name", LOSSES)
def test_each_loss_alone(name, two_texts):
    scores, truth = two_texts
    alone = losses(scores, truth, scales(), [name])
    assert list(alone) == [name]
    assert float(alone[name]) == pytest.approx(float(losses(scores, truth, scales())[name]))


def test_losses_as_printed_by_hand(two_texts):
    """Eq. 17: cross-entropy of the probability. Eq. 18: wrong cosines, and what right ones lack."""
    found = losses(*two_texts, scales(), PRINTED)
    assert list(found) == list(PRINTED)
    p = 1.0 / (1.0 + np.exp([-2.0, 1.0, -0.5]))
    assert float(found["eq17"]) == pytest.approx(-np.log([p[0], 1 - p[1], p[2]]).mean())
    assert float(found["eq18"]) == pytest.approx(0.1 + ((1 - 0.9) + (1 - 0.3)) / 2)


def test_what_relational_matching_never_scored_is_not_fused(two_texts):
    scores, truth = two_texts
    before = float(losses(scores, truth, scales(), ["fusion"])["fusion"])
    loud = scores._replace(residual=scores.residual + tensor([0.0, 0.0, 50.0, 0.0]))
    assert float(losses(loud, truth, scales(), ["fusion"])["fusion"]) == pytest.approx(before)
    twice = scales()._replace(relational=tensor(2.0))
    e = np.exp([6.0 + 1.0, 3.0 + 2.0])
    found = losses(scores, truth, twice, ["fusion"])["fusion"]
    assert float(found) == pytest.approx(-np.log(e[0] / e.sum()), rel=1e-5)


def test_a_text_and_a_place_of_two_texts_are_not_mirrored(two_texts):
    """sim(text i, place j) is not sim(text j, place i): own candidates are judged, no others."""
    scores, truth = two_texts
    before = losses(scores, truth, scales(), ["match", "similarity"])
    other = scores._replace(embedding=torch.flip(scores.embedding, [0]))
    after = losses(other, truth, scales(), ["match", "similarity"])
    assert {n: float(x) for n, x in before.items()} == {n: float(x) for n, x in after.items()}
