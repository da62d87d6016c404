"""Names that users type on the command line, apart from the modules that do the work, which take seconds to import."""

#: Scores of an evaluation
METRICS = ["normalized_performance", "return", "success"]
#: Figures of scores
FIGURES = ["iqm", "tasks", "aggregates", "profile", "improvement", "ratio"]
#: Figure of POR's classifier, drawn from the runs' logs
ORDER = "order"
