"""The paper's figures and claims, made again: plan, scores, verdicts, pictures, report."""
