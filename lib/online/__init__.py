"""The online system (paper Sec. V): every stage, frame by frame."""

from lib.online.pipeline import STAGES, FrameResult, OnlinePipeline, Settings

__all__ = ["STAGES", "FrameResult", "OnlinePipeline", "Settings"]
