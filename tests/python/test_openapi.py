"""openapi.yaml is valid OpenAPI 3.1, and the binary prints the committed text."""

import os
import pathlib
import subprocess

import yaml
from openapi_spec_validator import OpenAPIV31SpecValidator, validate

root = pathlib.Path(os.environ["VASCULUM_ROOT"]) if "VASCULUM_ROOT" in os.environ else pathlib.Path(__file__).parents[2]
text = (root / "openapi.yaml").read_text()
document = yaml.safe_load(text)
assert document["openapi"].startswith("3.1"), document["openapi"]
assert len(document["paths"]) > 10, "the description names too few operations"
validate(document, cls=OpenAPIV31SpecValidator)
printed = subprocess.run([os.environ["VASCULUM_BIN"], "openapi"], check=True, capture_output=True, text=True).stdout
assert printed == text, "openapi.yaml is not what the binary prints: run `vasculum openapi > openapi.yaml`"
print(f"openapi.yaml: valid OpenAPI {document['openapi']}, {len(document['paths'])} paths, equal to the binary's")
