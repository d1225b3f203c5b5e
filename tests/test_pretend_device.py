"""The pretended device refuses what CUDA refuses and counts what CUDA would wait for."""

import pytest
import torch
from pretend_device import Mixture
from trips import counted

from neural_sim.field.grid import GridField

CPU = torch.Generator()
MIXTURES = {
    "sum of vectors": lambda x: x + torch.ones(6),
    "in place on a CPU number": lambda x: torch.zeros(()).add_(x.sum()),
    "concatenation": lambda x: torch.cat([x, torch.ones(1)]),
    "selection by a CPU index": lambda x: x.index_select(0, torch.tensor([1])),
    "a CPU tensor by an index on the device": lambda x: torch.ones(9)[x.long()],
    "factory with a CPU generator": lambda x: torch.randn(3, device=x.device, generator=CPU),
    "drawing in place with a CPU generator": lambda x: x.normal_(generator=CPU),
    "a layer left on the CPU": lambda x: torch.nn.Linear(6, 2)(x),
}
TRIPS = {
    "wait": [
        lambda x: float(x.sum()), lambda x: bool((x > 1).any()), lambda x: x[x > 2], lambda x: x.nonzero(),
        lambda x: torch.bincount(x.long()), lambda x: x.unique(), lambda x: x.repeat_interleave(x.long()),
    ],
    "to_host": [lambda x: x.cpu(), lambda x: torch.zeros(6).copy_(x), lambda x: x.tolist()],
    "to_device": [
        lambda x: torch.tensor([1.0, 2.0], device=x.device), lambda x: x.copy_(torch.zeros(6)),
        lambda x: x[torch.tensor([1, 2])], lambda x: x.new_tensor([1.0]),
    ],
    "": [
        lambda x: x * torch.tensor(2.0), lambda x: x[1:3] + 1.0, lambda x: torch.where(x > 1, x, 0.0),
        lambda x: x.repeat_interleave(x.long(), output_size=15), lambda x: x[x.argsort()], lambda x: x.new_zeros(3),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", MIXTURES)
def test_what_cuda_refuses_is_refused(pretend, name):
    with pytest.raises(Mixture):
        MIXTURES[name](torch.arange(6.0, device="pretend"))


@pytest.mark.parametrize(("kind", "number"), [(kind, i) for kind in TRIPS for i in range(len(TRIPS[kind]))])
def test_trips_are_counted_by_kind(pretend, kind, number):
    x = torch.arange(6.0, device="pretend")
    with counted() as ledger:
        TRIPS[kind][number](x)
    assert {key[0] for key in ledger.trips} == ({kind} if kind else set())


def test_derivatives_of_every_mode_are_those_of_the_cpu(pretend):
    def loss(weight):
        return ((torch.arange(6.0, device=weight.device).view(2, 3) @ weight).sin() ** 2).sum()

    weight = torch.randn(3, 3, dtype=torch.float32, generator=torch.Generator().manual_seed(0))
    along = torch.ones(3, 3)
    for take in (
        lambda w, v: torch.func.grad(loss)(w),
        lambda w, v: torch.func.jvp(loss, (w,), (v,))[1],
        lambda w, v: torch.func.jvp(torch.func.grad(loss), (w,), (v,))[1],
    ):
        found = take(weight.to("pretend"), along.to("pretend"))
        assert found.device.type == "pretend" and torch.equal(found.cpu(), take(weight, along))


def test_a_trip_names_the_line_of_the_package(pretend):
    with counted() as ledger:
        GridField().to("pretend")
    assert ledger.trips and all(place.startswith("field/grid.py") for _, _, place in ledger.trips)
