"""OpenVLA's prompts: the question it was trained on, alone and with a subgoal."""

from mme_vla.processing.prompt import Piece, PromptFormat, PromptInput, warn_once
from mme_vla.registry import PROMPTS


@PROMPTS.register("openvla")
class OpenVla(PromptFormat):
    """The question that OpenVLA was trained on, the goal in lower case."""

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        return [(f"In: What action should the robot take to {self.language(inputs)}?\nOut:", True)]

    def language(self, inputs: PromptInput) -> str:
        """What the robot is asked to do."""
        return inputs.goal.strip().lower()


@PROMPTS.register("openvla_subgoal")
class OpenVlaSubgoal(OpenVla):
    """The same question with the subgoal behind the goal; the plain one where there is none."""

    reads_subgoal = True

    def language(self, inputs: PromptInput) -> str:
        """The goal without its full stop, and the subgoal."""
        if inputs.subgoal is None:
            warn_once(
                "The prompt format 'openvla_subgoal' got no subgoal: such steps use the plain"
                " prompt."
            )
            return super().language(inputs)
        goal = inputs.goal.strip().removesuffix(".")
        return f"{goal}; current subgoal: {inputs.subgoal.strip()}".lower()
