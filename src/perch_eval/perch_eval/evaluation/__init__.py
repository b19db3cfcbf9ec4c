"""The papers' tables and figures, regenerated and judged."""
