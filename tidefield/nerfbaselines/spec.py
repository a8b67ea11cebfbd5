"""Register Tidefield as a method of NerfBaselines: its entry point, or a file of NERFBASELINES_REGISTER."""

from nerfbaselines import register

register(
    {
        "id": "tidefield",
        "method_class": "tidefield.nerfbaselines.method:TidefieldMethod",
        "metadata": {
            "name": "Tidefield",
            "description": "A network over neighbouring views, trained across scenes and then on the scene",
            "paper_title": "View synthesis in tidal flat environments with spherical harmonics and neighboring views "
            "integration",
            "paper_link": "https://doi.org/10.23919/cje.2024.00.158",
            "licenses": [{"name": "Apache-2.0"}],
        },
        "implementation_status": {},
    }
)
