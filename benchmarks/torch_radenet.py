"""RADE-Net in PyTorch, only for comparing speed and as reference values of tests.

The network follows the description of the authors' one. Tensors have its names, so that
`radejax.weights.radenet_torch` can convert state dicts in both directions.
"""

import torch
from torch import nn
from torch.nn import functional


def single_conv(inputs, outputs, groups):
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.GroupNorm(groups, outputs),
        nn.SiLU(),
    )


class SingleConv(nn.Module):
    """3 x 3 convolution, GroupNorm and SiLU."""

    def __init__(self, inputs, outputs, groups):
        super().__init__()
        self.single_conv = single_conv(inputs, outputs, groups)

    def forward(self, x):
        return self.single_conv(x)


class DoubleConv(nn.Module):
    """Two `SingleConv` and a shortcut, which has a 1 x 1 convolution if the widths differ."""

    def __init__(self, inputs, outputs, groups):
        super().__init__()
        self.double_conv = nn.Sequential(
            SingleConv(inputs, outputs, groups), SingleConv(outputs, outputs, groups)
        )
        self.adjust_input = None
        if inputs != outputs:
            self.adjust_input = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x):
        shortcut = x if self.adjust_input is None else self.adjust_input(x)
        return self.double_conv(x) + shortcut


class Bottleneck(nn.Module):
    """Two residual blocks."""

    def __init__(self, width, groups):
        super().__init__()
        self.conv1 = DoubleConv(width, width, groups)
        self.conv2 = DoubleConv(width, width, groups)

    def forward(self, x):
        return self.conv2(self.conv1(x))


class Upsample(nn.Module):
    """Transposed 2 x 2 convolution with stride 2."""

    def __init__(self, width):
        super().__init__()
        self.upsample = nn.ConvTranspose2d(width, width, 2, stride=2)

    def forward(self, x):
        return self.upsample(x)


class ChannelAttention(nn.Module):
    """Factor per channel from its maximum and mean."""

    def __init__(self, width):
        super().__init__()
        hidden = max(1, width // 16)
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x):
        def mlp(v):
            return self.fc2(torch.relu(self.fc1(v)))

        weight = torch.sigmoid(mlp(x.amax((2, 3))) + mlp(x.mean((2, 3))))
        return x * weight[:, :, None, None]


class SpatialAttention(nn.Module):
    """Factor per bin from the maximum and mean over channels, in the given order."""

    def __init__(self, mean_first):
        super().__init__()
        self.mean_first = mean_first
        self.convolution = nn.Conv2d(2, 1, 7, padding=3)

    def forward(self, x):
        pooled = [x.amax(1, keepdim=True), x.mean(1, keepdim=True)]
        if self.mean_first:
            pooled.reverse()
        return x * torch.sigmoid(self.convolution(torch.cat(pooled, 1)))


class CBAM(nn.Module):
    """Channel and spatial attention of the authors' code ("official") or the paper ("paper")."""

    def __init__(self, width, groups, kind):
        super().__init__()
        self.kind = kind
        self.channel_attention = ChannelAttention(width)
        self.spatial_attention = SpatialAttention(kind == "paper")
        if kind == "official":
            self.start_conv = SingleConv(width, width, groups)
            self.end_conv = SingleConv(width, width, groups)

    def forward(self, x):
        if self.kind == "paper":
            return self.spatial_attention(self.channel_attention(x))
        x = self.start_conv(x)
        return self.end_conv(x + self.spatial_attention(self.channel_attention(x)))


def stem_conv(inputs, outputs, size, groups):
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False),
        nn.GroupNorm(groups, outputs),
        nn.SiLU(),
    )


class Stem(nn.Module):
    """Stem with separate convolutions of Doppler and elevation, and one that mixes them."""

    def __init__(self, doppler, elevation, width, groups):
        super().__init__()
        self.doppler = doppler
        self.doppler_conv = stem_conv(doppler, width, 1, groups)
        self.elevation_conv = stem_conv(elevation, width // 2, 1, groups)
        self.mix_conv = stem_conv(width + width // 2, width, 3, groups)

    def forward(self, x):
        doppler = self.doppler_conv(x[:, : self.doppler])
        elevation = self.elevation_conv(x[:, self.doppler :])
        return self.mix_conv(torch.cat([doppler, elevation], 1))


class Backbone(nn.Module):
    """U-shaped encoder and decoder with optional attention on the skip connections."""

    def __init__(self, c):
        super().__init__()
        widths, groups = tuple(c["widths"]), c["num_groups"]
        self.levels = len(widths)
        inputs = c["doppler_bins"] + c["elevation_bins"]
        if c["input_stem"]:
            self.transform_input = Stem(
                c["doppler_bins"], c["elevation_bins"], widths[0], groups
            )
        else:
            self.start_conv = nn.Conv2d(inputs, widths[0], 3, padding=1)
        x = widths[0]
        for i, width in enumerate(widths, 1):
            self.add_module(f"encoder_block_{i}", DoubleConv(x, width, groups))
            x = width
        self.bottleneck = Bottleneck(x, groups)
        for i, width in enumerate((*widths[-2::-1], c["decoder_width"]), 1):
            skip = widths[-i]
            self.add_module(f"upsample_{i}", Upsample(x))
            if c["cbam"] != "off":
                self.add_module(f"cbam_{i}", CBAM(skip, groups, c["cbam"]))
            self.add_module(f"decoder_block_{i}", DoubleConv(x + skip, width, groups))
            x = width

    def forward(self, x):
        start = getattr(self, "start_conv", None) or self.transform_input
        x = start(x)
        skips = []
        for i in range(1, self.levels + 1):
            x = getattr(self, f"encoder_block_{i}")(x)
            skips.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.bottleneck(x)
        for i in range(1, self.levels + 1):
            skip = skips.pop()
            x = getattr(self, f"upsample_{i}")(x)
            if hasattr(self, f"cbam_{i}"):
                skip = getattr(self, f"cbam_{i}")(skip)
            x = getattr(self, f"decoder_block_{i}")(torch.cat([x, skip], 1))
        return x


class PlainBlock(nn.Module):
    """Block of the plain neck: convolution, GroupNorm and SiLU."""

    def __init__(self, width, groups, dilation=1):
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)
        self.gn = nn.GroupNorm(groups, width)

    def forward(self, x):
        return functional.silu(self.gn(self.conv(x)))


class DilatedBlock(nn.Module):
    """Residual block of the dilated neck."""

    def __init__(self, width, groups, dilation):
        super().__init__()
        self.conv1 = PlainBlock(width, groups, dilation)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.gn = nn.GroupNorm(groups, width)

    def forward(self, x):
        return functional.silu(x + self.gn(self.conv2(self.conv1(x))))


class Neck(nn.Module):
    """Neck of three blocks, whose dilations are 1, 2 and 3 in the dilated neck."""

    def __init__(self, c):
        super().__init__()
        width, groups = c["decoder_width"], c["num_groups"]
        if c["neck"] == "dilated":
            blocks = [DilatedBlock(width, groups, i) for i in (1, 2, 3)]
        else:
            blocks = [PlainBlock(width, groups) for _ in range(3)]
        self.neck = nn.Sequential(*blocks)

    def forward(self, x):
        return self.neck(x)


class Head(nn.Module):
    """Head of one narrow convolution block, or of three wide ones if expanded."""

    def __init__(self, c, outputs):
        super().__init__()
        width, groups = c["decoder_width"], c["num_groups"]
        layers, x = [], width
        widths = [width] * 3 if c["heads"] == "expanded" else [min(64, width // 2)]
        for w in widths:
            layers += [*single_conv(x, w, groups)]
            x = w
        self.head = nn.Sequential(*layers, nn.Conv2d(x, outputs, 1))

    def forward(self, x):
        return self.head(x)


class Heads(nn.Module):
    """Heads of the heatmap and the box parameters."""

    def __init__(self, c):
        super().__init__()
        self.heatmap_head = Head(c, c["num_classes"])
        self.reg_head = Head(c, 8)

    def forward(self, x):
        return self.heatmap_head(x), self.reg_head(x)


class RadeNet(nn.Module):
    """Detector from `[B, D+E, R, A]`, padded, to logits `[B, C, R, A]` and boxes `[B, 8, R, A]`.

    `config` has the fields of `config.model`.
    """

    def __init__(self, config):
        super().__init__()
        self.backbone = Backbone(config)
        self.neck = Neck(config)
        self.head = Heads(config)

    def forward(self, x):
        return self.head(self.neck(self.backbone(x)))
