"""The paper, one module for every equation; `p4dgs_ref.table` lists them in the paper's order."""
