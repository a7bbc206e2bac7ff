"""The paper's two networks, and variants. Inputs are (batch, 1, Ny, Nx), normalised as `normalise` does; heatmaps are (batch, 1, Ny, Nx).

A network is `body` behind `front`. `front` passes frames on as they are, or whitens them.
"""

import torch
from torch import nn
from torch.nn import functional

# Below this many standard deviations of the noise a frame's maximum is no light, and is not blown up to one.
FLOOR_SIGMA = 10.0


def normalise(frames: torch.Tensor) -> torch.Tensor:
    """Frames in units of the noise, (batch, 1, Ny, Nx), over their own maximum or `FLOOR_SIGMA`, whichever is more."""
    return frames / frames.amax(dim=(1, 2, 3), keepdim=True).clamp_min(FLOOR_SIGMA)


class Whiten(nn.Module):
    """Frames with their principal components brought to one size where light stands out of the noise, and left out elsewhere.

    Light falls on every place of the ground alike, so all structure in the components' variances is the blur's: dividing
    it out sharpens the spots as far as the noise allows. Learned from samples, not from a model of the spot. Per axis the
    components are those of the frames' rows (columns); V: variance of each pair of components; 1: the noise's.
    """

    def __init__(self, nx: int, ny: int):
        super().__init__()
        self.register_buffer("columns", torch.eye(nx))
        self.register_buffer("rows", torch.eye(ny))
        self.register_buffer("weights", torch.ones(ny, nx))

    def learn(self, frames: torch.Tensor) -> None:
        """frames: (batch, 1, Ny, Nx) in units of the noise, some thousands."""
        light = frames[:, 0].double()
        scale = light.amax(dim=(1, 2), keepdim=True)
        noise = (1.0 / scale**2).mean()
        light = light / scale
        rows = torch.linalg.eigh(torch.einsum("bij,bkj->ik", light, light)).eigenvectors
        columns = torch.linalg.eigh(torch.einsum("bij,bik->jk", light, light)).eigenvectors
        variance = torch.einsum("ai,bac,cj->bij", rows, light, columns).square().mean(0)
        # Wiener's share of the signal over the signal's size.
        signal = (variance - noise).clamp_min(0.0)
        weights = signal.sqrt() / variance
        weights = torch.where(signal > noise, weights, 0.0)
        whitened = torch.einsum("ai,ij,bij,cj->bac", rows, weights, torch.einsum("ai,bac,cj->bij", rows, light, columns), columns)
        self.rows.copy_(rows)
        self.columns.copy_(columns)
        self.weights.copy_(weights / whitened.std())

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        with torch.autocast(frames.device.type, enabled=False):
            components = self.rows.T @ frames @ self.columns
            return self.rows @ (components * self.weights) @ self.columns.T


def block(inputs: int, outputs: int, separable: bool) -> list[nn.Module]:
    if separable and inputs > 1:
        convolution = [
            nn.Conv2d(inputs, inputs, 3, padding=1, groups=inputs, bias=False),
            nn.Conv2d(inputs, outputs, 1, bias=False),
        ]
    else:
        convolution = [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)]
    return [*convolution, nn.BatchNorm2d(outputs), nn.ReLU()]


class Network(nn.Module):
    """`body` behind `front`."""

    def __init__(self, body: nn.Module, front: nn.Module | None = None):
        super().__init__()
        self.front = front or nn.Identity()
        self.body = body

    def forward(self, frames: torch.Tensor):
        return self.body(self.front(frames))


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
        self.layers = nn.Sequential(*layers, head)

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.layers(frames).float())


class Dilated(nn.Module):
    """Nine 3×3 convolutions, dilated by 1, 2, 4, 8, 16, 8, 4, 2, 1, so that each pixel sees 93: for spots that melt into each other
    (Yu and Koltun 2016). A 1×1 sigmoid head."""

    def __init__(self, width: int = 16):
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 1
        for dilation in (1, 2, 4, 8, 16, 8, 4, 2, 1):
            convolution = nn.Conv2d(inputs, width, 3, padding=dilation, dilation=dilation, bias=False)
            layers += [convolution, nn.BatchNorm2d(width), nn.ReLU()]
            inputs = width
        head = nn.Conv2d(width, 1, 1)
        nn.init.constant_(head.bias, -4.0)
        self.layers = nn.Sequential(*layers, head)

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.layers(frames).float())


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
    learned where the target heatmap is bright. Frames are padded with darkness to sides that are multiples of 16.
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
        ny, nx = frames.shape[2:]
        kept, x = [], functional.pad(frames, (0, -nx % 16, 0, -ny % 16))
        for stage in self.down:
            x = stage(x)
            kept.append(x)
            x = self.pool(x)
        x = self.bottom(x)
        for up, merge, skip in zip(self.up, self.merge, reversed(kept)):
            x = merge(torch.cat([up(x), skip], dim=1))
        x = x[:, :, :ny, :nx]
        return torch.sigmoid(self.heatmap(x).float()), self.coordinates(x).float()


BODIES = {
    "cnn16": lambda: Hybrid(16),
    "cnn16-separable": lambda: Hybrid(16, separable=True),
    "cnn32": lambda: Hybrid(32),
    "dilated16": Dilated,
    "unet": UNet,
}
NETWORKS = [*BODIES, *(f"{name}-white" for name in BODIES)]


def build(name: str, nx: int, ny: int) -> Network:
    """One of `NETWORKS`, untrained."""
    front = Whiten(nx, ny) if name.endswith("-white") else None
    return Network(BODIES[name.removesuffix("-white")](), front)
