"""The closed forms of documents 000 and 002, as references that tests compare with."""

from polhode.documents import document_000 as document_000, document_002 as document_002
