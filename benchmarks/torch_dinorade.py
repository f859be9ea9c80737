"""DinoRADE in PyTorch, for comparison only.

The network is that of `configs/dinorade.py` without options, with the layers and sizes of the paper
and the authors' code, and every query counts as in view. Deformable attention has the pure PyTorch
form (`grid_sample`), which the authors' code uses if its CUDA operator is not built. Self-attention
is PyTorch's fused operator. Tensors of the radar branch have the names of the authors' RADE-Net,
and the others those of radejax's parameters (`networks.torch_state`).
"""

import collections

import torch
import torch_radenet
from torch import nn
from torch.nn import functional


class Block(nn.Module):
    """Transformer block with rotary position embedding of patches and layer scale."""

    def __init__(self, c):
        super().__init__()
        width, self.heads = c["hidden_size"], c["num_heads"]
        self.norm_1, self.norm_2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query, self.value, self.out = (nn.Linear(width, width) for _ in range(3))
        self.key = nn.Linear(width, width, bias=False)
        self.up = nn.Linear(width, c["mlp_dim"])
        self.down = nn.Linear(c["mlp_dim"], width)
        self.scale_1 = nn.Parameter(torch.ones(width))
        self.scale_2 = nn.Parameter(torch.ones(width))

    def forward(self, x, cos, sin):
        b, t, c = x.shape
        y = self.norm_1(x)
        query, key, value = (
            layer(y).reshape(b, t, self.heads, -1).transpose(1, 2)
            for layer in (self.query, self.key, self.value)
        )
        prefix = t - cos.shape[0]

        def rotate(z):
            fixed, patches = z[:, :, :prefix], z[:, :, prefix:]
            first, second = patches.chunk(2, -1)
            turned = patches * cos + torch.cat([-second, first], -1) * sin
            return torch.cat([fixed, turned], 2)

        y = functional.scaled_dot_product_attention(rotate(query), rotate(key), value)
        x = x + self.scale_1 * self.out(y.transpose(1, 2).reshape(b, t, c))
        y = self.down(functional.gelu(self.up(self.norm_2(x))))
        return x + self.scale_2 * y


class ViT(nn.Module):
    """Image transformer from normalized images `[B, 3, H, W]` to patch tokens `[B, h, w, C]`."""

    def __init__(self, c):
        super().__init__()
        width, self.patch = c["hidden_size"], c["patch_size"]
        self.patch_embed = nn.Conv2d(3, width, self.patch, stride=self.patch)
        self.prefix_tokens = nn.Parameter(torch.randn(1, 1 + c["num_registers"], width))
        self.layers = nn.ModuleList([Block(c) for _ in range(c["num_layers"])])
        self.norm = nn.LayerNorm(width)
        rows, columns = (n // self.patch for n in c["size"])
        for name in ("cos", "sin"):  # of the rotary angles, loaded with the weights
            table = torch.zeros(rows * columns, width // c["num_heads"])
            self.register_buffer(name, table)

    def forward(self, image):
        x = self.patch_embed(image)
        b, c, h, w = x.shape
        x = torch.cat(
            [self.prefix_tokens.expand(b, -1, -1), x.flatten(2).transpose(1, 2)], 1
        )
        for block in self.layers:
            x = block(x, self.cos, self.sin)
        return self.norm(x)[:, self.prefix_tokens.shape[1] :].reshape(b, h, w, c)


class CameraNeck(nn.Module):
    """Upsampling from patch tokens `[B, h, w, C]` to a camera map `[B, features, 4h, 4w]`."""

    def __init__(self, inputs, features):
        super().__init__()
        self.proj = nn.Linear(inputs, features)
        self.up_1 = nn.ConvTranspose2d(features, features, 4, 2, 1)
        self.up_2 = nn.ConvTranspose2d(features, features, 4, 2, 1)
        self.refine = nn.Conv2d(features, features, 3, padding=1)
        for name in ("up_1", "up_2", "refine"):
            self.add_module(f"{name}_norm", nn.BatchNorm2d(features))

    def forward(self, tokens):
        x = self.proj(tokens).permute(0, 3, 1, 2)
        for name in ("up_1", "up_2", "refine"):
            x = getattr(self, name)(x)
            x = functional.relu(getattr(self, f"{name}_norm")(x))
        return x


class Attention(nn.Module):
    """Deformable cross-attention of lifted queries, averaged over the queries of a bin."""

    def __init__(self, width, heads, points):
        super().__init__()
        self.heads, self.points = heads, points
        self.sampling_offsets = nn.Linear(width, heads * points * 2)
        self.attention_weights = nn.Linear(width, heads * points)
        self.value_proj = nn.Linear(width, width)
        self.output_proj = nn.Linear(width, width)

    def forward(self, feature, scale, points, camera):
        """Maps `[B, N, C]`, `[B, N, E]`, `[N, E, 2]` and `[B, C, h, w]` to `[B, N, C]`."""
        b, n, c = feature.shape
        h, w = camera.shape[2:]
        query = (scale[..., None] * feature[:, :, None]).flatten(1, 2)
        shape = (b, query.shape[1], self.heads, self.points)
        offsets = self.sampling_offsets(query).reshape(*shape, 2)
        weights = self.attention_weights(query).reshape(shape).softmax(-1)
        step = torch.tensor([w, h], device=feature.device)
        places = 2 * (points.reshape(1, -1, 1, 1, 2) + offsets / step) - 1
        grid = places.transpose(1, 2).flatten(0, 1)
        value = self.value_proj(camera.flatten(2).transpose(1, 2))
        value = value.transpose(1, 2).reshape(b * self.heads, -1, h, w)
        samples = functional.grid_sample(value, grid, align_corners=False)
        weights = weights.transpose(1, 2).reshape(b * self.heads, 1, -1, self.points)
        out = (samples * weights).sum(-1).reshape(b, c, -1).transpose(1, 2)
        return self.output_proj(out).reshape(b, n, -1, c).mean(2)


class DinoRade(nn.Module):
    """Detector from projection and image to logits and boxes, with a frozen image backbone.

    Args:
        c: `config.model` of `configs/dinorade.py`.
        points: `[R * A, E, 2]` reference points (x, y) in 0..1 of the queries in the image.
    """

    def __init__(self, c, points):
        super().__init__()
        width, fusion, bins = c["decoder_width"], c["fusion"], c["elevation_bins"]
        segments = fusion["num_elevation"]
        self.doppler_bins = c["doppler_bins"]
        self.image_backbone = ViT(c["image"]).requires_grad_(False)
        self.image_neck = CameraNeck(c["image"]["hidden_size"], width)
        self.backbone = torch_radenet.Backbone(c)
        self.neck, self.head = torch_radenet.Neck(c), torch_radenet.Heads(c)
        self.radar_neck, self.camera_neck = torch_radenet.Neck(c), torch_radenet.Neck(c)
        self.weighting = nn.Sequential(
            collections.OrderedDict(
                hidden=nn.Linear(bins, 64), relu=nn.ReLU(), out=nn.Linear(64, segments)
            )
        )
        self.attention = Attention(width, fusion["num_heads"], fusion["num_points"])
        self.gate_hidden = nn.Linear(2 * width, width)
        self.gate_out = nn.Linear(width, width)
        self.dropout = nn.Dropout(fusion["dropout"])
        self.register_buffer("points", points, persistent=False)

    def embed(self, image):
        """Normalizes images `[B, H, W, 3]` uint8 and returns their patch tokens."""
        with torch.no_grad():
            x = image.permute(0, 3, 1, 2).float() / 255
            mean = torch.tensor([0.485, 0.456, 0.406], device=x.device)
            deviation = torch.tensor([0.229, 0.224, 0.225], device=x.device)
            x = (x - mean[:, None, None]) / deviation[:, None, None]
            return self.image_backbone(x)

    def forward(self, x, image):
        """Takes projections `[B, D+E, R, A]` with padded R and A, and uint8 `[B, H, W, 3]`."""
        elevation = x[:, self.doppler_bins :]
        x = self.radar_neck(self.backbone(x))
        camera = self.camera_neck(self.image_neck(self.embed(image)))
        x = self._fuse(x, elevation, camera)
        return self.head(self.neck(self.dropout(x)))

    def _fuse(self, x, elevation, camera):
        b, c, r, a = x.shape
        radar = x.flatten(2).transpose(1, 2)
        scale = self.weighting(elevation.flatten(2).transpose(1, 2)).softmax(-1)
        seen = self.attention(radar, scale, self.points, camera)
        gate = functional.relu(self.gate_hidden(torch.cat([radar, seen], -1)))
        gate = torch.sigmoid(self.gate_out(gate))
        x = gate * radar + (1 - gate) * seen
        return x.transpose(1, 2).reshape(b, c, r, a)
