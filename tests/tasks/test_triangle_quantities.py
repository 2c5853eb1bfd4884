"""What maps make of triangles: by compiled loops as by plain operations, and known values."""

import math

import pytest
import torch

from nsm.tasks import triangle_quantities
from nsm.tasks.triangle_quantities import centres, determinants, forms

OF = {"forms": (forms, 3), "determinants": (determinants, 2), "centres": (centres, 3)}


def fan(width: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    """Nine corners (9, width), eight triangles around the first."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(9, width, generator=generator, dtype=dtype)
    around = torch.arange(8)
    return image, torch.stack(
        [torch.zeros(8, dtype=torch.long), 1 + around, 1 + (around + 1) % 8], 1
    )


@pytest.mark.parametrize("name", OF)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_is_as_plain(
    name: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    of, width = OF[name]
    image, faces = fan(width, dtype)
    found = []
    for compiled in (True, False):
        with monkeypatch.context() as patch:
            if not compiled:
                patch.setattr(triangle_quantities, "suit_compiled", lambda *_: False)
            x = image.clone().requires_grad_()
            value = of(x, faces)
            (
                value.square() * torch.arange(1, len(faces) + 1).view(-1, *[1] * (value.dim() - 1))
            ).sum().backward()
            found.append((value.detach(), x.grad))
    close = (
        {"rtol": 1e-5, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    )
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, **close)


@pytest.mark.parametrize("name", OF)
def test_gradients_are_finite_differences(name: str) -> None:
    of, width = OF[name]
    image, faces = fan(width)
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: of(x, faces), image)
    assert torch.autograd.gradgradcheck(lambda x: of(x, faces), image)


def test_a_right_angle() -> None:
    """Legs of 3 and 4: the form is diagonal, the area 6, and turning it over is negative."""
    image = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 1]])
    assert forms(image, faces)[0].tolist() == [[9.0, 0.0], [0.0, 16.0]]
    assert determinants(image, faces).tolist() == [12.0, -12.0]
    torch.testing.assert_close(centres(image, faces), torch.tensor([[1.0, 4 / 3]] * 2))


def test_forms_do_not_change_when_turned() -> None:
    image, faces = fan(3)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=image.dtype)
    torch.testing.assert_close(forms(image @ turn.T + 1, faces), forms(image, faces))
