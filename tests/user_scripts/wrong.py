"""Mistakes that a type checker finds before anything runs: behind each what mypy says and what pyright says of it."""

import jsmitsm as js

cloud = js.interval(0.0, 1.0, 11)
problem = js.Problem(lambda u, x: js.laplacian(u)(x), dict.fromkeys(("left", "right"), js.dirichlet(0.0)))
kernel = js.SuperGaussian(h=0.1, d=4.0)

js.solv(problem, cloud)  # wrong: attr-defined, reportAttributeAccessIssue
js.from_polygn([(0, 0), (1, 0), (0, 1)], 0.1)  # wrong: attr-defined, reportAttributeAccessIssue
js.sdf.circel((0, 0), 1.0)  # wrong: attr-defined, reportAttributeAccessIssue
js.plot.solutoin(cloud)  # wrong: attr-defined, reportAttributeAccessIssue
js.files.to_meshes(cloud)  # wrong: attr-defined, reportAttributeAccessIssue

sol = js.solve(problem, cloud, method="Q")  # wrong: arg-type, reportArgumentType
js.solve(problem, cloud, formulation="lsqr")  # wrong: arg-type, reportArgumentType
js.solve(problem, cloud, solver="direct")  # wrong: arg-type, reportArgumentType
js.solve(problem, cloud, degree=4)  # wrong: call-arg, reportCallIssue
js.solve(cloud, cloud)  # wrong: arg-type, reportArgumentType
js.factorize(problem, cloud, method="IV")  # wrong: arg-type, reportArgumentType
js.tune(problem, cloud, kernel, method="Q")  # wrong: arg-type, reportArgumentType
js.tune(problem, cloud, kernel, parameters=("h", "D"))  # wrong: arg-type, reportArgumentType
js.tune(problem, cloud, kernel, objective="estimated")  # wrong: arg-type, reportArgumentType
js.tune(problem, cloud, kernel, step=5)  # wrong: call-arg, reportCallIssue
js.continuation(lambda c: problem, cloud, [0.0, 1.0], solver="Q")  # wrong: call-overload, reportArgumentType

values: str = sol.u  # wrong: assignment, reportAssignmentType
anywhere: int = sol([[0.5]])  # wrong: assignment, reportAssignmentType
slopes: str = sol.grad([[0.5]])  # wrong: assignment, reportAssignmentType
points: list[float] = cloud.points  # wrong: assignment, reportAssignmentType
print(sol.coeficients)  # wrong: attr-defined, reportAttributeAccessIssue
js.SuperGaussian(h=0.1)  # wrong: call-arg, reportCallIssue
js.Problem(lambda u, x: u(x), {"left": 0.0})  # wrong: dict-item, reportArgumentType
js.interval("0", 1.0, 11)  # wrong: arg-type, reportArgumentType
js.stencils(cloud, sise=9)  # wrong: call-arg, reportCallIssue
