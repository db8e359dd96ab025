"""Names of the folders and files in a workspace."""

# imported kapture folders
MAPPING, QUERY, QUERY_GT, REFERENCE = "mapping", "query", "query_gt", "reference"

# outputs of stages
PREPROCESSED = "preprocessed"
# maps of photographs: the photographs with estimated poses, and the matches used to estimate them
POSED, PHOTOGRAPH_MATCHES = "posed", "matches/photographs"
LOCAL_FEATURES, GLOBAL_FEATURES = "local_features", "global_features"
MAPPING_PAIRS, QUERY_PAIRS = "pairs/mapping.txt", "pairs/query.txt"
QUERY_CANDIDATES = "pairs/query_candidates.txt"  # before reranking
MAPPING_MATCHES, QUERY_MATCHES = "matches/mapping", "matches/query"
MAPPING_PYRAMID, QUERY_PYRAMID = "pyramid/mapping", "pyramid/query"
UNREFINED_MAP, SPARSE, MAP = "map_unrefined", "map_sparse", "map"
UNREFINED_POSES, REFINEMENT_TIMING = "localized_unrefined", "timing_refinement.csv"
LOCALIZED, SUBMISSIONS, EVALUATION = "localized", "submissions", "evaluation"
TIMING = "timing.csv"

FEATURES = ""  # the workspace itself, which holds local and global features
