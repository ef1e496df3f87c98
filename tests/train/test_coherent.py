"""Choices that stay with a frontier for a while: as likely as the softmax says, and alike from one to the next."""

from __future__ import annotations

import torch

from imagine.train.networks.choice import draw_coherent, places_of
from imagine.train.networks.coherent import coherent_noise, gumbel_at

PLACES = torch.tensor([[0.0, 0.0], [12.0, 3.0], [-7.0, 9.0]])
SCORES = torch.tensor([1.0, 0.0, -0.5])


def draws(steps: int, agents: int, places: torch.Tensor = PLACES) -> torch.Tensor:
    noise = coherent_noise(steps, agents, torch.Generator().manual_seed(0))
    shape = (agents, *places.shape)
    return torch.stack([draw_coherent(SCORES.expand(agents, -1), row, places.expand(shape)) for row in noise])


def test_frontiers_that_lie_apart_are_chosen_as_often_as_the_softmax_says() -> None:
    chosen = draws(1, 20_000)[0]
    shares = torch.bincount(chosen, minlength=3) / len(chosen)
    torch.testing.assert_close(shares, torch.softmax(SCORES, dim=0), atol=0.02, rtol=0.0)


def test_the_next_choice_is_mostly_the_same_and_a_late_one_is_drawn_anew() -> None:
    chosen = draws(64, 4000)
    again = (torch.softmax(SCORES, dim=0) ** 2).sum()
    assert (chosen[1] == chosen[0]).float().mean() > 0.95
    assert abs((chosen[60] == chosen[0]).float().mean() - again) < 0.05


def test_frontiers_beside_each_other_share_their_chance() -> None:
    noise = coherent_noise(1, 3000, torch.Generator().manual_seed(1))[0]
    near = torch.tensor([[2.0, 2.0], [2.3, 2.1], [9.0, 2.0]]).expand(3000, 3, 2)
    values = torch.corrcoef(gumbel_at(noise, near).T)
    assert values[0, 1] > 0.9
    assert abs(values[0, 2]) < 0.1


def test_places_are_in_the_map_whatever_axes_they_are_shown_along() -> None:
    poses = torch.tensor([[3.0, -1.0, 2.1]])
    wanted = torch.tensor([[5.0, 4.0]])
    offset = (wanted - poses[:, :2]) / 10.0
    cosine, sine = torch.cos(poses[0, 2]), torch.sin(poses[0, 2])
    turned = torch.stack([cosine * offset[0, 0] + sine * offset[0, 1], cosine * offset[0, 1] - sine * offset[0, 0]])
    frontiers = torch.zeros(1, 1, 14)
    for along_heading, shown in ((False, offset[0]), (True, turned)):
        frontiers[0, 0, 8:10] = shown
        torch.testing.assert_close(places_of(frontiers, poses, along_heading)[0], wanted)
