"""Commands of the stages that other packages bring: each runs in a finished workspace."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from megloc_kapture.cli.common import Common, Working
from megloc_kapture.errors import OptionError
from megloc_kapture.pipeline.executors import available_cores, single_threaded
from megloc_kapture.pipeline.plan import describe, run_plan
from megloc_kapture.pipeline.presets import assigned
from megloc_kapture.pipeline.workspace import Workspace
from megloc_kapture.plugin_loading import load_plugin, plugin_class
from megloc_kapture.plugins import STAGES
from megloc_kapture.stages.work import Work


@dataclass(frozen=True, kw_only=True)
class OutsideStage(Working, Common):
    stage: ClassVar[str]

    workspace: Annotated[Path, tyro.conf.arg(aliases=["-w"])]
    """Workspace of megloc eval that has what the stage reads."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Change an option of the stage: key=value; may be repeated."""

    def run(self) -> int:
        """Run it."""
        console = self.console()
        stage = load_plugin(STAGES, self.stage, assigned(self.set))
        if not (self.workspace / "stages").is_dir():
            raise OptionError(f"{self.workspace} is no workspace of megloc eval")
        workspace = Workspace(self.workspace)
        with (
            workspace.lock(),
            single_threaded(),
            self.open_executor(workspace.root) as executor,
        ):
            run_plan(
                [stage],
                workspace,
                Work(executor, console.track, self.workers or available_cores()),
                on_start=console.say,
                on_report=lambda report: console.say(describe(report)),
            )
        return 0


def stage_command(name: str) -> type[Any]:
    """The command of a registered stage; raises PluginError where it cannot be loaded."""
    command = make_dataclass(name, [], bases=(OutsideStage,), frozen=True, kw_only=True)
    command.stage = name  # type: ignore[attr-defined]
    command.__doc__ = getdoc(plugin_class(STAGES, name)) or f"Run the stage {name}."
    return command
