"""Does a budget end what it should, by number and by time?"""

from unjam.training.choice import Budget


def test_episodes_are_counted_and_a_part_may_be_asked_for() -> None:
    budget = Budget(20)
    assert budget.allows(20)
    assert not budget.allows(21)
    assert not budget.allows(11, part=0.5)
    budget.spend(8)
    assert budget.allows(2, part=0.5)
    assert not budget.allows(3, part=0.5)
    assert budget.allows(12)
    assert (budget.spent, budget.episodes) == (8, 20)


def test_minutes_end_it_by_how_long_episodes_took_before() -> None:
    now = [0.0]
    budget = Budget(1000, minutes=2.0, clock=lambda: now[0])
    assert budget.allows(500), "nobody knows yet how long an episode takes"
    budget.spend(10)
    now[0] = 60.0
    assert budget.allows(10)
    assert not budget.allows(11)
    assert not budget.allows(1, part=0.5)
