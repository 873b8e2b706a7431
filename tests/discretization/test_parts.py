"""What several processes tell of a whole cloud, against one: parts are threads here."""

import threading

import numpy as np
import pytest

from jsmitsm.discretization.parts.whole import ALONE, Part, Whole
from jsmitsm.discretization.resolution import turning
from jsmitsm.linear.conditioning import inverse_norm
from jsmitsm.parallel.look.conditioning import Entries
from jsmitsm.parallel.team import Team

SIZE = 3


class Comm:
    """A communicator of one of SIZE threads."""

    board, barrier = [None] * SIZE, threading.Barrier(SIZE)

    def __init__(self, rank):
        self.rank = rank

    def Get_rank(self):
        return self.rank

    def Get_size(self):
        return SIZE

    def allgather(self, value):
        self.board[self.rank] = value
        self.barrier.wait(60)
        found = list(self.board)
        self.barrier.wait(60)
        return found


def together(ask):
    """What ``ask(team)`` returns to each thread."""
    found = [None] * SIZE

    def one(rank):
        found[rank] = ask(Team(Comm(rank)))

    threads = [threading.Thread(target=one, args=(rank,), daemon=True) for rank in range(SIZE)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    return found


def parted(team, count, owner, points=None):
    """The whole as a part sees it, which knows every second particle of the others too."""
    number = np.flatnonzero((owner == team.rank) | (np.arange(count) % 2 == 0))
    mine = np.flatnonzero(owner == team.rank)

    def every(step):
        at = np.concatenate(team.gather(mine[mine % step == 0]))
        return points[np.sort(at)]

    own = owner[number] == team.rank
    return number, Whole(Part(own, True, 1.0, number, count, every, team.largest, team.total, team.gather))


@pytest.mark.parametrize("seed", range(4))
def test_parts_tell_what_one_process_tells(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(5, 60))
    owner = rng.integers(0, 2 + seed % 2, count)  # of two sometimes, so that one has no particle
    x = rng.normal(size=count) * 10.0 ** rng.integers(-200, 200, count)
    x[: count // 2] = np.round(x[: count // 2], 0)  # equal ones, and zeros

    def ask(team):
        number, told = parted(team, count, owner)
        mine = told.own(x[number])
        ranks = [told.quantile(mine, at) for at in (0.0, 0.2, 0.5, 1.0)]
        low = told.named(np.flatnonzero(x[number] < 0)).tolist()
        return ranks, low, told.most(np.array([mine.max(initial=-np.inf), -1.0])).tolist(), told.total(len(mine))

    alone = (
        [ALONE.quantile(x, at) for at in (0.0, 0.2, 0.5, 1.0)], np.flatnonzero(x < 0).tolist(), [x.max(), -1.0], count
    )  # fmt: skip
    for ranks, *rest in together(ask):
        # Between two numbers one interpolates, and rounds.
        np.testing.assert_allclose(ranks, alone[0], rtol=1e-15)
        assert tuple(rest) == alone[1:]


def test_what_tells_the_depth_is_that_of_one_process(monkeypatch):
    monkeypatch.setattr(turning, "MOST", 70)  # so that only every third particle is asked for its neighbours
    rng = np.random.default_rng(2)
    points, owner = rng.uniform(size=(200, 2)), rng.integers(0, SIZE, 200)
    held = rng.choice(200, 30, replace=False)

    def ask(team):
        number, told = parted(team, 200, owner, points)
        free = turning._free(points[number], [np.flatnonzero(np.isin(number, held))], told.part)
        return *turning._sample(points[number], 12, told.part), np.sort(free, axis=0)

    sample, radius = turning._sample(points, 12, None)
    free = turning._free(points, [held], None)
    assert radius is not None and len(sample) == 100 and len(free) == 170
    for found in together(ask):
        np.testing.assert_array_equal(found[0], sample)
        assert found[1] == radius
        np.testing.assert_array_equal(found[2], np.sort(free, axis=0))


def test_the_norm_of_an_inverse_is_that_of_one_process():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(17, 17)) + 4.0 * np.eye(17)
    inverse = np.linalg.inv(a)

    def ask(team):
        entries = Entries(team, [6, 0, 11][team.rank])
        mine = slice(entries.first, entries.first + entries.here)

        def apply(b, transpose):
            whole = np.concatenate(team.gather(b))
            return ((inverse.T if transpose else inverse) @ whole)[mine]

        return inverse_norm(apply, 17, entries)

    alone = inverse_norm(lambda b, transpose: (inverse.T if transpose else inverse) @ b, 17)
    assert alone == pytest.approx(np.abs(inverse).sum(axis=0).max(), rel=0.5)
    np.testing.assert_allclose(together(ask), alone, rtol=1e-13)
