import torch

from model_fixtures import input_cameras
from nerfdiff.field.decoder import Decoder
from nerfdiff.field.field import TriplaneField
from nerfdiff.field.triplane import Triplane


def test_decoder_by_hand():
    torch.manual_seed(0)
    decoder = Decoder(5, 7, density_shift=-2.0, density_scale=3.0)
    features = torch.randn(4, 5)
    rgb, density = decoder(features)
    pre = features @ decoder.hidden.weight.T + decoder.hidden.bias
    out = pre * torch.sigmoid(pre) @ decoder.output.weight.T + decoder.output.bias
    torch.testing.assert_close(rgb, 1 / (1 + torch.exp(-out[:, :3])))
    torch.testing.assert_close(density, 3 * torch.log1p(torch.exp(out[:, 3] - 2)))


def test_density_does_not_overflow():
    decoder = Decoder(1, 1, density_shift=0.0, density_scale=1.0)
    torch.nn.init.constant_(decoder.output.weight, 1e4)
    _, density = decoder(torch.tensor([[1e4], [-1e4]]))
    assert density.isfinite().all() and (density >= 0).all()


def test_a_scene_in_other_units_looks_the_same():
    """Scaling the scene scales lengths up and density down: the optical depth stays."""
    torch.manual_seed(0)
    decoder = Decoder(4, 8, density_shift=0.0, density_scale=2.0)
    planes, camera, points = torch.randn(1, 3, 4, 6, 6), input_cameras(1, 6, 6), torch.tensor([[[0.1, -0.2, 1.2]]])
    small = TriplaneField(Triplane(planes, camera, torch.tensor([0.8]), torch.tensor([1.8])), decoder)
    large = TriplaneField(Triplane(planes, camera, torch.tensor([8.0]), torch.tensor([18.0])), decoder)
    (rgb, density), (rgb_large, density_large) = small(points), large(10 * points)
    torch.testing.assert_close(rgb, rgb_large)
    torch.testing.assert_close(density, 10 * density_large)


def test_nothing_is_before_the_near_plane():
    decoder = Decoder(4, 8, density_shift=5.0, density_scale=2.0)
    field = TriplaneField(
        Triplane(torch.zeros(1, 3, 4, 6, 6), input_cameras(1, 6, 6), torch.tensor([0.8]), torch.tensor([1.8])), decoder
    )
    _, density = field(torch.tensor([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.5], [0.0, 0.0, -1.0]]]))
    assert density[0, 0] > 0 and density[0, 1:].tolist() == [0.0, 0.0]
