"""Tidefield inside NerfBaselines; runs where NerfBaselines is installed, and nothing else imports it."""
