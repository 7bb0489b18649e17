"""What several test modules use: fakes, small recordings and commands in processes of their own."""

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
