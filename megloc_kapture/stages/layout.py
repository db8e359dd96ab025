"""Names of what a run keeps in its workspace, and which of them its options lead to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from megloc_kapture.stages.options import PipelineOptions

# as imported; kapture folders
MAPPING, QUERY, QUERY_GT, REFERENCE = "mapping", "query", "query_gt", "reference"
PREPROCESSED = "preprocessed"
POSED, PHOTOGRAPH_MATCHES = "posed", "matches/photographs"  # of photographs without poses
LOCAL_FEATURES, GLOBAL_FEATURES = "local_features", "global_features"
MAPPING_PAIRS, QUERY_PAIRS = "pairs/mapping.txt", "pairs/query.txt"
QUERY_CANDIDATES = "pairs/query_candidates.txt"  # before they are reranked
MAPPING_MATCHES, QUERY_MATCHES = "matches/mapping", "matches/query"
MAPPING_PYRAMID, QUERY_PYRAMID = "pyramid/mapping", "pyramid/query"
UNREFINED, SPARSE, MAP = "map_unrefined", "map_sparse", "map"
UNREFINED_POSES, REFINEMENT_TIMING = "localized_unrefined", "timing_refinement.csv"
LOCALIZED, SUBMISSIONS, EVALUATION = "localized", "submissions", "evaluation"
TIMING = "timing.csv"
FEATURES = ""  # features folder of local and global features: the workspace itself


@dataclass(frozen=True)
class Layout:
    """Where, with these options, the images, features and poses are that stages read."""

    options: PipelineOptions
    posed: bool = False

    @property
    def mapping(self) -> str:
        """Kapture folder of the map's images, as everything after pre-processing sees them; of
        photographs, once they have poses, the posed ones."""
        if self.posed:
            return POSED
        return f"{PREPROCESSED}/{MAPPING}" if self.options.preprocesses() else MAPPING

    @property
    def query(self) -> str:
        """Kapture folder of the queries' images; see :attr:`mapping`."""
        return f"{PREPROCESSED}/{QUERY}" if self.options.preprocesses() else QUERY

    @property
    def reference(self) -> tuple[str, ...]:
        """The model that the dataset comes with, where the map has points of it."""
        return (REFERENCE,) if self.options.uses_given_map() else ()

    @property
    def mapping_matches(self) -> tuple[str, ...]:
        """Features folders with the matches of map images."""
        if not self.options.triangulates():
            return ()
        again = self.options.matches_again()
        return (MAPPING_MATCHES, MAPPING_PYRAMID) if again else (MAPPING_MATCHES,)

    @property
    def query_matches(self) -> tuple[str, ...]:
        """Features folders with the matches of queries."""
        again = self.options.matches_again()
        return (QUERY_MATCHES, QUERY_PYRAMID) if again else (QUERY_MATCHES,)

    @property
    def sparse_map(self) -> str:
        """The map before depth is estimated, where it is."""
        return MAP if self.options.mvs.mode == "off" else SPARSE

    @property
    def candidates(self) -> str:
        """Pairs of the queries that are matched; some of them are localized with."""
        return QUERY_CANDIDATES if self.options.reranking.reranks() else QUERY_PAIRS

    @property
    def poses(self) -> str:
        """The localized queries before poses are refined."""
        return UNREFINED_POSES if self.options.pose_refinement.refines() else LOCALIZED
