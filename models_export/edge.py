"""The recipe of pack ``edge``: small networks for two CPU cores."""

from __future__ import annotations

from models_export.data.real import RealData
from models_export.guided import GuidedRecipe
from models_export.metadata import depth_metadata, detector_metadata, uncertain_multibin_metadata
from models_export.nets.depth import DepthConfig, EdgeDepth
from models_export.nets.detector import DetectorConfig, EdgeDetector
from models_export.nets.multibin import EdgeMultibin, MultibinConfig
from models_export.recipe import NetworkRecipe, PackRecipe
from models_export.train.config import TrainConfig
from models_export.train.depth import DepthTask
from models_export.train.detector import DetectorTask
from models_export.train.multibin import MultibinTask
from models_export.train.nanodet_start import load_nanodet


def edge_recipe(
    detector: DetectorConfig | None = None,
    multibin: MultibinConfig | None = None,
    depth: DepthConfig | None = None,
    guided: GuidedRecipe | None = None,
) -> PackRecipe:
    """The pack as it is shipped, or with networks of other shapes."""
    return PackRecipe(
        name="edge",
        version="9",
        networks=(
            _detector(detector or DetectorConfig()),
            _multibin(multibin or MultibinConfig()),
            _depth(depth or DepthConfig()),
        ),
        guided=guided or GuidedRecipe(),
    )


def _detector(config: DetectorConfig) -> NetworkRecipe:
    return NetworkRecipe(
        name="detector",
        config=config,
        build=EdgeDetector,
        task=DetectorTask,
        training=TrainConfig(steps=12000, batch_size=24, learning_rate=6e-4, ema_decay=0.999),
        outputs=("p8", "p16", "p32"),
        metadata=detector_metadata,
        load_foreign=load_nanodet,
        real=RealData.detection,
        precision="int8",
        openvino=True,
    )


def _multibin(config: MultibinConfig) -> NetworkRecipe:
    return NetworkRecipe(
        name="multibin",
        config=config,
        build=EdgeMultibin,
        task=MultibinTask,
        training=TrainConfig(steps=20000, batch_size=128, learning_rate=1.5e-3),
        outputs=("vectors", "confidence", "residual", "outline", "log_sigma"),
        metadata=uncertain_multibin_metadata,
        real=RealData.vehicles,
        canvas_hw=(config.crop_px, config.crop_px),
        precision="int8",
    )


def _depth(config: DepthConfig) -> NetworkRecipe:
    return NetworkRecipe(
        name="depth",
        config=config,
        build=EdgeDepth,
        task=DepthTask,
        training=TrainConfig(steps=2500, batch_size=16, learning_rate=1e-3),
        outputs=("inverse_depth",),
        metadata=depth_metadata,
        precision="int8",
        for_export=EdgeDepth.with_folded_pooling,
    )
