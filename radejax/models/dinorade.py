"""DinoRADE, a radar-camera detector whose radar queries sample features of the image.

References:
    Leitgeb et al., DinoRADE, arXiv:2604.08074.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from radejax.core.errors import SIZE, UserError, check_options, require
from radejax.core.structures import DetectionMaps
from radejax.geometry.camera import Camera
from radejax.models import lifting
from radejax.models.fusion import Fusion
from radejax.models.image import STRIDE, CameraNeck, ResNetNeck, ResNetTrunk, normalize
from radejax.models.lifting import MARGIN_PX, LiftingAxes, ReferencePoints
from radejax.models.radenet import RadeNet
from radejax.models.vit import ViT

IMAGE_BACKBONE = "image_backbone"
"""Key of the image backbone in the parameters, which published checkpoints must not contain."""

_SCOPE = f"{IMAGE_BACKBONE}/"


class DinoRade(RadeNet, kw_only=True):
    """Radar-camera detector that fuses the features of a RADE-Net with those of an image.

    Attributes:
        vit: The image transformer, or None for a ResNet-50.
        fusion: Fusion of radar and camera map. Its `num_groups`, `dtype` and `remat` are
            replaced by those of this module.
        query_grid: Axes of the centers of the radar queries.
        image_size: Height and width of the images in pixels. The transformer resizes them
            to the nearest multiples of its patch size; reference points are fractions of
            height and width, so that they also apply to resized images.
        freeze: Whether to stop gradients at the output of the image backbone.
        resnet_width: Channels of the ResNet's stem; not used with a `vit`.
        standardize_image: Whether to normalize images by ImageNet's mean and standard
            deviation; if False, they are scaled to [0, 1].
    """

    vit: ViT | None
    fusion: Fusion
    query_grid: LiftingAxes
    image_size: tuple[int, int] = (720, 1280)
    freeze: bool = True
    resnet_width: int = 64
    standardize_image: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        image, size = "config.model.image", self.image_size
        check_options(vars(self), image, {"resnet_width": SIZE})
        is_possible = self.freeze or self.vit is not None
        expected = "True for a ResNet, whose first stages have fixed batch statistics"
        require(is_possible, f"{image}.freeze", self.freeze, expected)
        least, step = (STRIDE, STRIDE) if self.vit is None else (self.vit.patch_size, 1)
        is_possible = len(size) == 2 and all(n >= least and n % step == 0 for n in size)
        expected = f"height and width of at least {least} pixels, multiples of {step}"
        require(is_possible, f"{image}.size", size, expected)
        is_possible = self.fusion.out_of_view == "drop" or size[1] > 2 * MARGIN_PX
        expected = (
            f"a width above {2 * MARGIN_PX} for config.model.fusion.out_of_view = "
            f"'official', which leaves out {MARGIN_PX} pixels left and right"
        )
        require(is_possible, f"{image}.size", size, expected)
        kind, name = self.fusion.weighting, "config.model.fusion.weighting"
        is_possible = self.elevation_bins > 0 or kind == "off"
        require(is_possible, name, kind, "'off' without elevation channels")
        heads, width = self.fusion.num_heads, self.decoder_width
        expected = f"a divisor of decoder_width = {width}"
        require(width % heads == 0, "config.model.fusion.num_heads", heads, expected)

    def setup(self) -> None:
        shared = self._shared()
        dtype, width = shared["dtype"], self.decoder_width
        if self.vit is None:
            trunk = ResNetTrunk(self.resnet_width, dtype=dtype)
            self.image_backbone: ResNetTrunk | ViT = trunk
            self.image_neck: ResNetNeck | CameraNeck = ResNetNeck(
                width, self.resnet_width, dtype=dtype
            )
        else:
            remat = shared["remat"] and not self.freeze
            self.image_backbone = self.vit.clone(dtype=dtype, remat=remat, parent=None)
            self.image_neck = CameraNeck(width, dtype=dtype)
        self.image_fusion = self.fusion.clone(**shared, parent=None)

    @nn.compact
    def __call__(
        self,
        projection: Float[jax.Array, "B R A DE"],
        image: Real[jax.Array, "B _ _ _"] | None = None,
        camera: Camera | ReferencePoints | None = None,
        train: bool = False,
    ) -> DetectionMaps:
        """Predicts detection maps from projections and images.

        For frames without an image (`camera.is_valid` or `camera.has_image` is False), and
        if `image` and `camera` are None, only the radar is used.

        Args:
            projection: `[B, R, A, D+E]` projections with the Doppler channels first, in
                any float dtype.
            image: `[B, H, W, 3]` RGB images, either uint8 or floats that are normalized
                already; or their features `[B, h, w, C]` from `embed`.
            camera: A `Camera`, or reference points that were computed before, for all
                frames or for each.
            train: Whether to use batch statistics and dropout instead of running
                statistics.

        Returns:
            Maps on the padded bins, or on the projection's bins if `crop_output`.

        Raises:
            UserError: The projection has the wrong channels, the image has a size other
                than `image_size`, only one of image and camera is given, or the reference
                points do not match the projection.
        """
        padded = self._padded(projection)
        camera_map = reference = None
        if image is not None and camera is not None:
            reference = self._reference(camera, padded.shape)
            camera_map = self._camera_map(image, reference, train)
        elif image is not None or camera is not None:
            raise UserError(
                f"{'camera' if image is None else 'image'} is given without "
                f"{'image' if image is None else 'camera'}: give both or none"
            )
        x = self._features(padded)
        channels = padded.shape[-1] - self.elevation_bins
        elevation = padded[..., channels:]  # of the last frame
        x = self.image_fusion(x, elevation, camera_map, reference, train=train)
        return self._maps(x, projection)

    def embed(self, image: Real[jax.Array, "B H W 3"]) -> Float[jax.Array, "B h w C"]:
        """Computes the image backbone's features, which `__call__` accepts instead of images.

        Args:
            image: `[B, H, W, 3]` RGB images, uint8 or floats that are normalized already.

        Returns:
            `[B, h, w, C]` float32 patch tokens, or output of the ResNet's third stage.

        Raises:
            UserError: The image has a size other than `image_size`.
        """
        if tuple(image.shape[1:]) != (*self.image_size, 3):
            raise UserError(
                f"image is {tuple(image.shape)}, expected "
                f"{('B', *self.image_size, 3)} (config.model.image.size) or, if embedded"
                f" before, {('B', *self.feature_shape)}"
            )
        image = normalize(image, standardize=self.standardize_image)
        features = self.image_backbone(image)
        if self.vit is not None:
            features = features[:, self.vit.num_prefix :]
            features = features.reshape(image.shape[0], *self.feature_shape)
        return jax.lax.stop_gradient(features) if self.freeze else features

    @property
    def feature_shape(self) -> tuple[int, int, int]:
        """Shape `(h, w, C)` of one image's features."""
        height, width = self.image_size
        if self.vit is None:
            return height // STRIDE, width // STRIDE, 16 * self.resnet_width
        return (*self.vit.grid(height, width), self.vit.hidden_size)

    @nn.nowrap
    def is_frozen(self, name: str) -> bool:
        """Returns whether a parameter, given as a path like "image_backbone/...", is frozen."""
        return self.freeze and name.startswith(_SCOPE)

    def _reference(
        self, camera: Camera | ReferencePoints, shape: tuple[int, ...]
    ) -> ReferencePoints:
        b, r, a = shape[:3]
        if isinstance(camera, Camera):
            arrays = jax.tree.map(jnp.asarray, camera)
            out_of_view = self.fusion.out_of_view
            camera = lifting.reference_points(
                arrays, self.query_grid, r, a, out_of_view
            )
        expected = (r, a, self.query_grid.num_elevation)
        found = camera.is_valid.shape
        if found[1:] != expected or found[0] not in (1, b):
            raise UserError(
                f"reference points are {tuple(found)}, expected [{b} or 1, "
                f"{', '.join(map(str, expected))}]: frames, range, azimuth, elevation"
            )
        return camera

    def _camera_map(
        self, image: Real[jax.Array, "B _ _ _"], reference: ReferencePoints, train: bool
    ) -> Float[jax.Array, "B h w C"]:
        is_embedded = tuple(image.shape[1:]) == self.feature_shape
        features = image if is_embedded else self.embed(image)
        has_image = reference.has_image
        if has_image is None:
            has_image = jnp.ones(image.shape[0], bool)
        return self.image_neck(features, jnp.asarray(has_image), train=train)
