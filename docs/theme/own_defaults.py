"""Parameters that are told together have a default each; the parser of docstrings gives all of them the first one's."""

import griffe


class OwnDefaults(griffe.Extension):
    def on_object(self, *, obj, **_):
        if obj.docstring is None or not hasattr(obj, "parameters"):
            return
        for section in obj.docstring.parsed:
            if section.kind is griffe.DocstringSectionKind.parameters:
                for told in section.value:
                    if told.name in obj.parameters:
                        told.value = obj.parameters[told.name].default
