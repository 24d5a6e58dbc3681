"""Who runs frame sets: the pipeline that the settings name, in worker processes or in the service's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from service.logs import configure_logging
from service.nets.pack import load_pack
from service.nets.providers import is_gpu, offered
from service.pipeline import Pipeline, PipelineSettings
from service.scheduler import FrameSetRunner
from service.settings import Settings
from service.worker_processes import ProcessRunner

Load = Callable[[Settings], FrameSetRunner]


def load_pipeline(settings: Settings) -> Pipeline:
    """The service's own pipeline on the pack that the settings name. Raises PackError or InputError."""
    options = PipelineSettings(hard_mode=settings.hard_mode, detector_width=settings.detector_width)
    if settings.score_threshold is not None:
        options = replace(options, score_threshold=settings.score_threshold)
    if settings.min_fused_score is not None:
        options = replace(options, min_fused_score=settings.min_fused_score)
    pack = load_pack(
        settings.pack,
        provider=settings.provider,
        intra_op_threads=settings.intra_op_threads,
        concurrent_runs=settings.workers,
    )
    return Pipeline(pack, options)


def make_runner(settings: Settings, load: Load = load_pipeline) -> FrameSetRunner:
    """What the scheduler of a service with these settings runs. Raises what ``load`` raises.

    load: makes the pipeline; a function of a module, since worker processes look it up by its name.
    """
    on_gpu = settings.worker_kind == "auto" and is_gpu(settings.provider, offered())
    if settings.worker_kind == "thread" or on_gpu:
        return load(settings)
    return ProcessRunner(partial(_load_in_process, settings, load), settings.workers)


def _load_in_process(settings: Settings, load: Load) -> FrameSetRunner:
    configure_logging(settings.log_format, settings.log_level)
    # A process runs one set at a time.
    return load(settings.model_copy(update={"workers": 1}))
