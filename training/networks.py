"""The paper's two networks. Inputs are (batch, 1, Ny, Nx), normalised as `normalise` does; heatmaps are (batch, 1, Ny, Nx)."""

import torch
from torch import nn

# Below this many standard deviations of the noise a frame's maximum is no light, and is not blown up to one.
FLOOR_SIGMA = 10.0


def normalise(frames: torch.Tensor) -> torch.Tensor:
    """Frames in units of the noise, (batch, 1, Ny, Nx), over their own maximum or `FLOOR_SIGMA`, whichever is more."""
    return frames / frames.amax(dim=(1, 2, 3), keepdim=True).clamp_min(FLOOR_SIGMA)


def block(inputs: int, outputs: int, separable: bool) -> list[nn.Module]:
    if separable and inputs > 1:
        convolution = [
            nn.Conv2d(inputs, inputs, 3, padding=1, groups=inputs, bias=False),
            nn.Conv2d(inputs, outputs, 1, bias=False),
        ]
    else:
        convolution = [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)]
    return [*convolution, nn.BatchNorm2d(outputs), nn.ReLU()]


class Hybrid(nn.Module):
    """Four 3×3 convolutions with batch normalisation and ReLU, a 1×1 sigmoid head."""

    def __init__(self, width: int = 16, separable: bool = False):
        super().__init__()
        layers = block(1, width, separable)
        for _ in range(3):
            layers += block(width, width, separable)
        head = nn.Conv2d(width, 1, 1)
        # Nearly all of a heatmap is dark.
        nn.init.constant_(head.bias, -4.0)
        self.layers = nn.Sequential(*layers, head, nn.Sigmoid())

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return self.layers(frames)


class Stage(nn.Sequential):
    """Two 3×3 convolutions with batch normalisation and LeakyReLU."""

    def __init__(self, inputs: int, outputs: int):
        layers: list[nn.Module] = []
        for a, b in ((inputs, outputs), (outputs, outputs)):
            layers += [nn.Conv2d(a, b, 3, padding=1, bias=False), nn.BatchNorm2d(b), nn.LeakyReLU(0.1)]
        super().__init__(*layers)


class UNet(nn.Module):
    """The baseline: four stages down and four up with skips, a sigmoid heatmap head and a coordinate head.

    The coordinate head gives (batch, 2, Ny, Nx): the offset, in pixels, from a pixel to the nearest emitter; it is
    learned where the target heatmap is bright. The sides must be multiples of 16: pad them.
    """

    def __init__(self, width: int = 24):
        super().__init__()
        widths = [width, 2 * width, 4 * width, 8 * width]
        bottom = 10 * width
        self.down = nn.ModuleList(Stage(a, b) for a, b in zip([1, *widths], widths))
        self.bottom = Stage(widths[-1], bottom)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 2, stride=2) for a, b in zip([bottom, *widths[:0:-1]], widths[::-1])
        )
        self.merge = nn.ModuleList(Stage(2 * b, b) for b in widths[::-1])
        self.pool = nn.MaxPool2d(2)
        self.heatmap = nn.Conv2d(width, 1, 1)
        self.coordinates = nn.Conv2d(width, 2, 1)
        nn.init.constant_(self.heatmap.bias, -4.0)

    def forward(self, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        kept, x = [], frames
        for stage in self.down:
            x = stage(x)
            kept.append(x)
            x = self.pool(x)
        x = self.bottom(x)
        for up, merge, skip in zip(self.up, self.merge, reversed(kept)):
            x = merge(torch.cat([up(x), skip], dim=1))
        return torch.sigmoid(self.heatmap(x)), self.coordinates(x)


NETWORKS = {
    "cnn16": lambda: Hybrid(16),
    "cnn16-separable": lambda: Hybrid(16, separable=True),
    "cnn32": lambda: Hybrid(32),
    "unet": UNet,
}
