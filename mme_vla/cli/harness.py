"""`mme-vla harness --args.checkpoint=…`: a policy behind AI2's vla-evaluation-harness."""


def main() -> None:
    """Serve as the harness's own model servers do; `--help` lists its words."""
    from mme_vla.serving.harness import run_server

    run_server()
