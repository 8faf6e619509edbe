"""Node `gap_diagnosis_node`."""
