import torch

from nerfdiff.utils.images import to_signed, to_unit


def test_ranges_are_mapped_onto_each_other():
    unit, signed = torch.tensor([0.0, 0.25, 0.5, 1.0]), torch.tensor([-1.0, -0.5, 0.0, 1.0])
    assert torch.equal(to_signed(unit), signed) and torch.equal(to_unit(signed), unit)
