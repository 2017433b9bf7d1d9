"""The maximum: matching, Newton steps, rejection of outliers, fit statistics."""
