"""Tidefield inside nerfstudio: `ns-train tidefield`, and its data parser, which nerfstudio finds by their entry points.

Everything here runs where nerfstudio is installed; nothing else imports it.
"""
