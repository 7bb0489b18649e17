"""What stands between raw data and the network: images, normalisation, actions, prompt and
tokenizer.
"""

from mme_vla.processing.base import pad_width
from mme_vla.processing.images import (
    as_uint8_frames,
    augment_views,
    resize_with_pad,
    resize_with_pad_uint8,
    to_unit_range,
)
from mme_vla.processing.normalise import (
    NormStats,
    QuantileStats,
    RunningStats,
    normalize,
    unnormalize,
)
from mme_vla.processing.processor import Processor
from mme_vla.processing.prompt import PROMPTS, PromptFormat, PromptInput, SubgoalText, encode_prompt
from mme_vla.processing.tokenizer import Tokenizer

__all__ = [
    "PROMPTS",
    "NormStats",
    "Processor",
    "PromptFormat",
    "PromptInput",
    "QuantileStats",
    "RunningStats",
    "SubgoalText",
    "Tokenizer",
    "as_uint8_frames",
    "augment_views",
    "encode_prompt",
    "normalize",
    "pad_width",
    "resize_with_pad",
    "resize_with_pad_uint8",
    "to_unit_range",
    "unnormalize",
]
