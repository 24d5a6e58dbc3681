"""DPT-hybrid (Ranftl et al. 2021), the paper's depth net: ResNetV2-50's three stages, ViT-B/16, a convolutional decoder.

The modules and their weights' names are those of ``transformers``. Its forward pass is not used: it takes square images only
and finds the transformer's inner states through hooks.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor, nn
from torch.nn import functional as F

from models_export.nets.blocks import Normalise
from service.errors import InputError

if TYPE_CHECKING:
    # Importing it takes seconds, which training of the other networks need not pay.
    from transformers import DPTConfig

PATCH_PX = 16
"""Canvas pixels a token: the convolutional stages' stride."""
PRETRAINED_RATE = 0.1
"""Learning rate of the pretrained encoder over the decoder's: 1e-5 and 1e-4 in the paper."""


@dataclass(frozen=True)
class DptConfig:
    """Shape of the net; the defaults are the published one."""

    stride: int = 8
    """Canvas pixels an output cell; the head's full resolution is averaged to it."""
    image_px: int = 384
    """Side of the square images that the position embeddings were made for; they are interpolated to any other grid."""
    stem: int = 64
    """Channels of the first convolution."""
    stages: tuple[int, int, int] = (256, 512, 1024)
    """Channels at strides 4, 8, 16."""
    depths: tuple[int, int, int] = (3, 4, 9)
    """Bottleneck blocks a stage."""
    groups: int = 32
    """Of the stages' group normalisation."""
    width: int = 768
    """Channels of a token."""
    blocks: int = 12
    heads: int = 12
    mlp: int = 3072
    """Hidden channels of a transformer block's perceptron."""
    taps: tuple[int, int] = (8, 11)
    """Transformer blocks whose tokens the decoder reads, beside the stages at strides 4 and 8."""
    fusion: int = 256
    """Channels of the decoder."""


class DptHybrid(nn.Module):
    """uint8 canvases (B, H, W, 3) to affine-invariant inverse depth (B, H / stride, W / stride).

    Unlike the published head it does not end in a ReLU: the values are free up to a shift, so none of them is special, and
    from random weights the ReLU may start, and then stay, at nothing but zeros.
    """

    def __init__(self, config: DptConfig) -> None:
        super().__init__()
        from transformers import DPTForDepthEstimation

        self.config = config
        self.normalise = Normalise()  # mean and deviation 0.5 of 0..1
        self.model = DPTForDepthEstimation(_published(config))

    def load_pretrained(self, folder: Path) -> None:
        """Take all weights from a folder in the form of ``transformers`` (``config.json`` and ``model.safetensors``).

        Nothing is fetched. Raises InputError when the folder does not hold this architecture's weights.
        """
        from transformers import DPTForDepthEstimation

        remedy = "Give a local copy of a DPT-hybrid model in the form of transformers."
        if not folder.is_dir():
            raise InputError("no such folder.", field=str(folder), remedy=remedy)
        try:
            loaded, report = DPTForDepthEstimation.from_pretrained(
                folder, config=self.model.config, local_files_only=True, output_loading_info=True
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"cannot be loaded: {error}", field=str(folder), remedy=remedy) from error
        missing = sorted(report["missing_keys"])
        if missing:
            raise InputError(f"{len(missing)} weights are missing, '{missing[0]}' first.", field=str(folder), remedy=remedy)
        self.model.load_state_dict(loaded.state_dict())

    def paces(self) -> list[tuple[nn.Module, float]]:
        """Encoder and decoder, each with its factor of the learning rate."""
        return [(self.model.dpt, PRETRAINED_RATE), (nn.ModuleList([self.model.neck, self.model.head]), 1.0)]

    def with_folded_weights(self) -> DptHybrid:
        """A copy whose convolutions hold their standardised weights, with the same outputs: for export.

        Standardising is a batch norm in training mode over the weights, which ONNX Runtime does not run; of trained weights
        it is a constant.
        """
        folded = deepcopy(self).eval()
        _fold(folded.model.dpt.embeddings.backbone)
        return folded

    def forward(self, images: Tensor) -> Tensor:
        """H and W are multiples of 32."""
        rows, columns = images.shape[1] // PATCH_PX, images.shape[2] // PATCH_PX
        embedded = self.model.dpt.embeddings(self.normalise(images), interpolate_pos_encoding=True)
        tokens, states = embedded.last_hidden_states, list(embedded.intermediate_activations)
        for index, block in enumerate(self.model.dpt.encoder.layer):
            tokens = block(tokens)
            if index in self.config.taps:
                states.append(tokens)
        fused = self.model.neck(states, patch_height=rows, patch_width=columns)
        full = self.model.head.head[:-1](fused[self.model.config.head_in_index])
        return F.avg_pool2d(full, self.config.stride).squeeze(1)


def _published(config: DptConfig) -> DPTConfig:
    """The configuration of ``Intel/dpt-hybrid-midas``, at the sizes of ``config``."""
    from transformers import BitConfig, DPTConfig

    backbone = BitConfig(
        embedding_size=config.stem,
        hidden_sizes=list(config.stages),
        depths=list(config.depths),
        num_groups=config.groups,
        layer_type="bottleneck",
        global_padding="same",
        embedding_dynamic_padding=True,
        out_features=["stage1", "stage2", "stage3"],
    )
    side = config.image_px // PATCH_PX
    return DPTConfig(
        is_hybrid=True,
        backbone_config=backbone,
        backbone_featmap_shape=[1, config.stages[-1], side, side],
        image_size=config.image_px,
        patch_size=PATCH_PX,
        hidden_size=config.width,
        num_hidden_layers=config.blocks,
        num_attention_heads=config.heads,
        intermediate_size=config.mlp,
        neck_hidden_sizes=[*config.stages[:2], config.width, config.width],
        reassemble_factors=[1, 1, 1, 0.5],
        fusion_hidden_size=config.fusion,
        # Two for the stages, of which only the number counts, and the taps.
        backbone_out_indices=[2, 5, *config.taps],
        readout_type="project",
    )


def _fold(module: nn.Module) -> None:
    """Replace every weight-standardised convolution below ``module`` by a plain one, behind its padding if it has one."""
    from transformers.models.bit.modeling_bit import WeightStandardizedConv2d

    for name, child in module.named_children():
        if isinstance(child, WeightStandardizedConv2d):
            rows = child.weight.detach().flatten(1)
            sizes = child.in_channels, child.out_channels, child.kernel_size, child.stride, child.padding
            plain = nn.Conv2d(*sizes, bias=False)
            plain.weight = nn.Parameter(F.layer_norm(rows, rows.shape[1:], eps=child.eps).reshape(child.weight.shape))
            setattr(module, name, plain if child.pad is None else nn.Sequential(child.pad, plain))
        else:
            _fold(child)
