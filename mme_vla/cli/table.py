"""The commands by name: their modules, and what help says of them."""

from mme_vla.registry import Command, extensions, join_names

COMMANDS = {
    "train": Command(
        "mme_vla.cli.train",
        "train a policy",
        config="train",
        processes="shared",
        check="mme_vla.training.settings:TrainRun.from_config",
    ),
    "evaluate": Command(
        "mme_vla.cli.evaluate",
        "run a policy on the benchmark",
        config="evaluate",
        processes="shared",
        check="mme_vla.evaluation.rollout.settings:check_config",
    ),
    "results": Command(
        "mme_vla.cli.results",
        "tables, comparisons and a report from finished runs",
        processes="any",
    ),
    "inspect": Command(
        "mme_vla.cli.inspect",
        "what a checkpoint or a dataset holds, and predicted against recorded actions",
        config="inspect",
        processes="any",
        check="mme_vla.policy.run_folders:check_checkpoint",
    ),
    "serve": Command(
        "mme_vla.cli.serve",
        "put a policy behind a port",
        config="serve",
        check="mme_vla.serving.settings:ServeSettings.from_dict",
    ),
    "harness": Command(
        "mme_vla.serving.harness", "put a policy behind AI2's vla-evaluation-harness"
    ),
    "convert": Command(
        "mme_vla.cli.convert",
        "official HDF5 demonstrations to one LeRobot dataset",
        config="convert",
    ),
    "exec-starts": Command(
        "mme_vla.cli.exec_starts",
        "where the conditioning videos of a dataset end, if it has no such column",
        config="exec_starts",
    ),
    "cache": Command(
        "mme_vla.cli.cache",
        "the vision tokens of a dataset, computed once",
        config="cache",
        processes="shared",
    ),
    "record": Command(
        "mme_vla.cli.record",
        "demonstrate episodes of the benchmark and keep them as a dataset",
        config="record",
    ),
    "gallery": Command(
        "mme_vla.cli.gallery",
        "the tasks at a glance, one demonstrated episode each, on one page",
        config="show",
    ),
    "weights": Command("mme_vla.cli.weights", "a checkpoint from one format to another"),
    "subgoal-build": Command(
        "mme_vla.cli.subgoal_build",
        "training data of the subgoal predictors",
        config="subgoal_build",
    ),
    "subgoal-train": Command(
        "mme_vla.cli.subgoal_train",
        "fine-tune a subgoal predictor",
        config="subgoal_train",
        processes="shared",
    ),
    "sample": Command("mme_vla.cli.sample", "the dataset that the package ships, from a full one"),
    "train-tokenizer": Command("mme_vla.cli.train_tokenizer", "the small tokenizer of the package"),
    "docs": Command(
        "mme_vla.cli.docs", "this documentation as a site, built and opened without a network"
    ),
}
"""The core's commands by the name on the command line."""


def commands() -> dict[str, Command]:
    """All commands: the core's, its extras', and those of installed packages, in this order."""
    brought = [(extension, extension.commands) for extension in extensions()]
    return join_names("command", COMMANDS, brought)
