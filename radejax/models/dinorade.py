"""DinoRADE, a radar-camera detector whose radar queries sample features of the image.

References:
    Leitgeb et al., DinoRADE, arXiv:2604.08074.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from radejax.core.errors import UserError
from radejax.core.structures import DetectionMaps
from radejax.geometry.camera import Camera
from radejax.models import lifting
from radejax.models.fusion import Fusion
from radejax.models.image import CameraNeck, ResNetNeck, ResNetTrunk, normalize
from radejax.models.lifting import ReferencePoints
from radejax.models.options import DinoRadeOptions
from radejax.models.radenet import RadeNet
from radejax.models.vit import ViT

IMAGE_BACKBONE = "image_backbone"
"""Key of the image backbone in the parameters, which published checkpoints must not contain."""


class DinoRade(RadeNet):
    """Radar-camera detector that fuses the features of a RADE-Net with those of an image.

    Attributes:
        options: Options of the model.
        num_frames: As in `RadeNet`.
    """

    options: DinoRadeOptions

    def setup(self) -> None:
        options = self.options
        image = options.image
        width = options.decoder_width
        dtype = jnp.dtype(options.dtype)
        remat = options.remat != "none"
        if image.kind == "vit":
            self.image_backbone: ResNetTrunk | ViT = ViT(
                image, dtype=dtype, remat=remat and not image.freeze
            )
            self.image_neck: ResNetNeck | CameraNeck = CameraNeck(width, dtype=dtype)
        else:
            self.image_backbone = ResNetTrunk(image.resnet_width, dtype=dtype)
            self.image_neck = ResNetNeck(width, image.resnet_width, dtype=dtype)
        self.image_fusion = Fusion(
            options.fusion, num_groups=options.num_groups, dtype=dtype, remat=remat
        )

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
                than `options.image.size`, only one of image and camera is given, or the reference
                points do not match the projection.
        """
        padded = self._padded(projection)
        camera_map = reference = None
        if image is not None and camera is not None:
            reference = self._reference(camera, padded.shape)
            camera_map = self._camera_map(image, reference, train)
        elif image is not None or camera is not None:
            raise UserError("image and camera belong together: give both or none")
        x = self._features(padded)
        channels = padded.shape[-1] - self.options.elevation_bins
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
            UserError: The image has a size other than `options.image.size`.
        """
        options = self.options.image
        if tuple(image.shape[1:]) != (*options.size, 3):
            raise UserError(
                f"image is {tuple(image.shape)}, expected "
                f"{('B', *options.size, 3)} (config.model.image.size) or, if embedded"
                f" before, {('B', *options.feature_shape)}"
            )
        image = normalize(image, standardize=options.standardize)
        features = self.image_backbone(image)
        if options.kind == "vit":
            features = features[:, options.num_prefix :]
            features = features.reshape(image.shape[0], *options.feature_shape)
        return jax.lax.stop_gradient(features) if options.freeze else features

    @nn.nowrap
    def is_frozen(self, name: str) -> bool:
        """Returns whether a parameter, given as a path like "image_backbone/...", is frozen."""
        return self.options.image.freeze and name.startswith(f"{IMAGE_BACKBONE}/")

    def _reference(
        self, camera: Camera | ReferencePoints, shape: tuple[int, ...]
    ) -> ReferencePoints:
        b, r, a = shape[:3]
        fusion = self.options.fusion
        expected = (r, a, fusion.num_elevation)
        if isinstance(camera, Camera):
            arrays = jax.tree.map(jnp.asarray, camera)
            axes = self.options.query_grid
            camera = lifting.reference_points(
                arrays, axes, *expected, fusion.out_of_view
            )
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
        is_embedded = tuple(image.shape[1:]) == self.options.image.feature_shape
        features = image if is_embedded else self.embed(image)
        has_image = reference.has_image
        if has_image is None:
            has_image = jnp.ones(image.shape[0], bool)
        return self.image_neck(features, jnp.asarray(has_image), train=train)
