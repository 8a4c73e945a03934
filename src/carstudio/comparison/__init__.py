"""The paper's tables: models trained alike, scored alike, set beside the paper's own figures."""
