"""Version of the code, for generated files."""

import os
import subprocess
from pathlib import Path


def commit_id() -> str:
    """Return the short hash of the commit, with "+" if tracked files differ.

    It is "none" without git. OCUFILTER_COMMIT replaces it, for copies without history.
    """
    commit = os.environ.get("OCUFILTER_COMMIT")
    if commit:
        return commit
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
