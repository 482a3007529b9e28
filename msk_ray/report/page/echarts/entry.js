// What the report's charts use of Apache ECharts; see README.md.
import { use } from "echarts/core";
import { BarChart, LineChart, ParallelChart, ScatterChart } from "echarts/charts";
import { DataZoomInsideComponent, GridComponent, MarkLineComponent, ParallelComponent, TooltipComponent } from "echarts/components";
import { CanvasRenderer } from "echarts/renderers";
use([
  BarChart, LineChart, ParallelChart, ScatterChart,
  DataZoomInsideComponent, GridComponent, MarkLineComponent, ParallelComponent, TooltipComponent,
  CanvasRenderer,
]);
export { init } from "echarts/core";
