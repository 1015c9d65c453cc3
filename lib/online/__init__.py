"""The online system (paper Sec. V): every stage, frame by frame."""

from lib.online.pipeline import OnlinePipeline
from lib.online.result import STAGES, STATES, FrameResult, Settings

__all__ = ["STAGES", "STATES", "FrameResult", "OnlinePipeline", "Settings"]
