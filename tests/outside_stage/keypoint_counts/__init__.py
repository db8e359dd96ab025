from megloc_kapture.io.kapture import KaptureFolder
from megloc_kapture.stages.stage import Stage, StageWork
from megloc_kapture.values import Options


class CountOptions(Options):
    least: int = 0


class CountKeypoints(Stage):
    """Count the keypoints of every map image."""

    name, reads, writes = "count_keypoints", ("mapping", "local_features"), ("counts.csv",)
    Options = CountOptions

    def run(self, work: StageWork) -> dict[str, float]:
        folder = work.folder("mapping", "")
        images = folder.read().image_names()
        jobs = [(folder, image) for image in images]
        counts = dict(zip(images, work.map(count, jobs, "counting"), strict=True))
        rows = [f"{name},{n}\n" for name, n in counts.items() if n >= self.options.least]
        (work.out / "counts.csv").write_text("".join(rows))
        return {"images": len(rows)}


def count(job: tuple[KaptureFolder, str]) -> int:
    return job[0].keypoints(job[0].types("keypoints")[0]).length(job[1])
