"""Version of the code that made a file."""

import os
import subprocess
from pathlib import Path


def commit_id() -> str:
    """Return the checkout's short hash, with "+" if files differ; "none" without git.

    For a copy without history, set OCUFILTER_COMMIT.
    """
    told = os.environ.get("OCUFILTER_COMMIT")
    if told:
        return told
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> str | None:
        try:
            answer = subprocess.run(
                ("git", *arguments),
                cwd=root,
                capture_output=True,
                text=True,
                check=False,
            )
        except FileNotFoundError:
            return None
        return answer.stdout.strip() if answer.returncode == 0 else None

    head = git("rev-parse", "--short", "HEAD")
    if head is None:
        return "none"
    return head + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
